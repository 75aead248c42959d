"""Run directories in: what is read, and what is left out with which reason.

Attacks, each with its defence:
- a `run.json` that names folders of the reader's machine as its workspace, logs or checkpoints: a leaderboard
  drops the names; `report` leaves out a run directory that names folders outside itself.
"""

from __future__ import annotations

import contextlib
import operator
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run
from waiting import wait_until

from evopolicy_common.records.rescores import Rescored, RescoreRecord, encode_rescore, rescore_path
from evopolicy_results.reading.comparability import UNKNOWN_ISOLATION, MixedRunsError, mixtures
from evopolicy_results.reading.parallel import Processes
from evopolicy_results.reading.reader import count_changed_lines, find_run_dirs, load_runs, read_run, rescored
from evopolicy_results.reading.records import rows
from evopolicy_results.studies.study import study

VERSIONS = [
    Version(policy(gain=1.0), (-200.0, -100.0), -180.0),
    Version({"policy.py": "import nothing\n"}, (0.0,), None, "import_error"),
    Version(policy(gain=2.0), (-90.0,), -95.0, failed=(0,)),
]


def test_run_is_read_with_its_submits_and_hidden_scores(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS, rejected=2))
    assert (run.entry, run.env, run.budget, run.score) == ("Agent A", "gym/acrobot", 128, -95.0)
    assert [submit.status for submit in run.submits] == ["ok", "import_error", "ok"]
    assert [(submit.consumed_before, submit.consumed) for submit in run.submits] == [(0, 2), (2, 3), (3, 4)]
    assert [submit.mean_return for submit in run.submits] == [-150.0, None, -90.0]
    assert [submit.val_mean for submit in run.submits] == [-180.0, None, -95.0]
    assert [submit.changed_lines for submit in run.submits] == [None, None, 2]
    assert [submit.label for submit in run.scored] == ["s000", "s002"]
    assert run.selected.index == 2
    assert run.selected.n_failed_episodes == 1
    assert len(run.record.rejected_submits) == 2
    assert rows(run.submits)[0]["mean_return"] == -150.0


def test_run_is_read_from_checkpoints_when_feedback_is_gone(tmp_path: Path) -> None:
    folder = write_run(tmp_path, VERSIONS)
    for summary in folder.glob("workspace/feedback/*/summary.json"):
        summary.unlink()
    run = read_run(folder)
    assert [submit.consumed for submit in run.submits] == [2, 3, 4]
    assert [submit.status for submit in run.submits] == ["ok", "import_error", "ok"]


def test_a_run_whose_agent_never_played_is_left_out(tmp_path: Path) -> None:
    write_run(tmp_path, [], entry="Missing CLI", closed_reason="agent_failed")
    write_run(tmp_path, [], entry="Gave up")
    write_run(tmp_path, VERSIONS[1:2], entry="Crashed", closed_reason="agent_failed")
    found = study([tmp_path])
    assert found.entries == ["Crashed", "Gave up"]
    (left,) = found.left_out
    assert "failed before it used any budget" in left.reason


def left_out(runs: Path) -> str:
    """The reason why the only run there is left out."""
    loaded = load_runs([runs])
    assert loaded.runs == ()
    (left,) = loaded.left_out
    return left.reason


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"change": {"replay_of": "r-1"}}, "a replay of run r-1, and no run of its own"),
        ({"status": "cancelled"}, "was cancelled"),
        ({"status": "error"}, "worker lost"),
        *(
            ({"change": {"artifacts": {name: place}}}, f"artifacts.{name} is outside the run directory")
            for name in ("workspace", "checkpoints", "logs_agent")
            for place in ("/etc", "../other", "logs/../../other")
        ),
    ],
)
def test_an_unfinished_run_is_left_out_with_its_reason(
    tmp_path: Path, how: dict[str, Any], reason: str
) -> None:
    write_run(tmp_path, VERSIONS, **how)
    assert reason in left_out(tmp_path)


def test_unknown_fields_are_skipped(tmp_path: Path) -> None:
    assert read_run(write_run(tmp_path, VERSIONS, change={"mood": {"of": "the day"}})).score == -95.0


def test_a_rescore_in_which_episodes_report_no_success_has_no_success_rate(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS))
    best = run.record.outcome.best_submit_index
    assert best is not None
    for successes, expected in (((True, False), (True, False)), ((True, None), ())):
        played = Rescored(submit_index=best, returns=(1.0, 2.0), lengths=(1, 1), successes=successes)
        record = RescoreRecord(
            name="more", run=run.record.run, env=run.env, selected=best, n_cases=2, cases_hash="sha256:0",
            cases_from="secret", cases_secret=True, random_returns=(0.0, 0.0), checkpoints=(played,),
        )  # fmt: skip
        path = rescore_path(run.path, "more")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encode_rescore(record))
        (found,) = rescored([run], "more")
        assert found.record.outcome.heldout_successes == expected


DAMAGES: dict[str, tuple[str, bytes | None]] = {
    "unfinished": ("run.json", None),
    "run.json: ": ("run.json", b'{"schema_version": 1, "outcome"'),
    "run.json": ("run.json", b""),
    "run.json: not": ("run.json", b"\xff\xfe{}"),
    "run.json: not a": ("run.json", b"[" * 200_000),
    "submit_000/summary.json": ("workspace/feedback/submit_000/summary.json", b'{"schema_version": 1,'),
    "_meta.json": ("checkpoints/submit_000/_meta.json", b"[]"),
}
"""Reason to the file and what becomes of it; None: it goes."""
CHANGES: dict[str, dict[str, Any]] = {
    "final_score": {"outcome": {"final_score": "high"}},
    "schema_version 99": {"schema_version": 99},
    "no final_score": {"outcome": {"final_score": None}},
    "selected submit 77": {"outcome": {"best_submit_index": 77}},
}


@pytest.mark.parametrize("reason", [*DAMAGES, *CHANGES, "not a regular file"])
def test_damaged_run_is_left_out_with_its_reason(tmp_path: Path, reason: str) -> None:
    good = write_run(tmp_path, VERSIONS, exp_id="good")
    bad = write_run(tmp_path, VERSIONS, exp_id="bad", change=CHANGES.get(reason))
    if reason in DAMAGES:
        name, content = DAMAGES[reason]
        (bad / name).unlink() if content is None else (bad / name).write_bytes(content)
    elif reason not in CHANGES:
        (bad / "run.json").unlink()
        (bad / "run.json").mkdir()
    loaded = load_runs([tmp_path])
    assert [run.path for run in loaded.runs] == [good]
    assert [left.path for left in loaded.left_out] == [bad]
    assert reason in loaded.left_out[0].reason


def test_run_without_an_ok_submit_stays_in_without_a_score(tmp_path: Path) -> None:
    write_run(tmp_path, [VERSIONS[1]])
    (run,) = load_runs([tmp_path]).runs
    assert run.score is None
    assert run.selected is None
    assert run.scored == ()


def test_same_run_given_twice_counts_once_and_a_copy_is_named(tmp_path: Path) -> None:
    write_run(tmp_path / "a", VERSIONS)
    write_run(tmp_path / "b", VERSIONS)
    twice = load_runs([tmp_path / "a", tmp_path / "a"])
    assert (len(twice.runs), twice.left_out) == (1, ())
    copied = load_runs([tmp_path])
    assert len(copied.runs) == 1
    assert "repeats the run" in copied.left_out[0].reason


def test_path_without_runs_is_listed(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").touch()
    loaded = load_runs([tmp_path / "empty", tmp_path / "notes.txt", tmp_path / "absent"])
    assert {left.path.name: left.reason for left in loaded.left_out} == {
        "empty": "no run directory here",
        "notes.txt": "a file, not a run directory",
        "absent": "no such folder",
    }


def test_a_run_inside_a_run_is_not_searched_for(tmp_path: Path) -> None:
    outer = write_run(tmp_path, VERSIONS)
    write_run(outer / "workspace" / "system", VERSIONS)
    assert find_run_dirs([tmp_path])[0] == [outer]


def test_reading_in_several_processes_gives_the_same_runs_and_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for number in range(45):
        write_run(tmp_path, VERSIONS[:1], exp_id=f"e{number:02d}")
    (tmp_path / "Agent-A" / "gym_acrobot" / "e07" / "run.json").write_text("{")
    with Processes(2) as processes:
        assert load_runs([tmp_path], processes=processes) == load_runs([tmp_path])
    assert capfd.readouterr() == ("", "")


def test_an_item_over_which_its_process_ends_costs_that_item_alone() -> None:
    items: list[Any] = [partial(abs, -number) for number in range(20)]
    items[5] = partial(os._exit, 7)
    items[19] = partial(os.kill, 0, signal.SIGKILL)
    with Processes(2) as processes:
        found = list(processes.map(operator.call, items, lambda item, why: (item, why)))
        assert list(processes.map(abs, [-1], lambda item, why: why)) == [1]  # the next stage has children too
    assert found[:5] + found[6:19] == [*range(5), *range(6, 19)]
    assert found[5] == (items[5], "the process that read it ended with status 7")
    assert found[19][1] == "the process that read it ended with status -9"


def test_who_stops_reading_waits_for_no_item() -> None:
    items: list[Any] = [partial(abs, -1)] * 8 + [partial(time.sleep, 1000.0)] * 8
    found: Any = Processes(2).map(operator.call, items, lambda item, why: (item, why))
    assert next(found) == 1
    found.close()


READS = "import sys, time; from pathlib import Path\nfrom evopolicy_results.reading.reader import load_runs\n"
READS += "from evopolicy_results.reading.parallel import Processes\n"
# It waits at the first run that is read, since a quick machine has read them all before a test looks.
READS += "def tell(done, total):\n    print(done, flush=True)\n    time.sleep(60)\n"
READS += "load_runs([Path(sys.argv[1])], processes=Processes(2), progress=tell)"


def semaphores() -> set[str]:
    """Those of Python's processes. Other programs have shared memory there too."""
    return {path.name for path in Path("/dev/shm").iterdir() if path.name.startswith(("sem.", "psm_"))}


def test_a_report_that_is_killed_leaves_nothing_behind(tmp_path: Path) -> None:
    for number in range(45):
        write_run(tmp_path, VERSIONS, exp_id=f"e{number:02d}")
    mark = {"EVOTEST_REPORT": str(tmp_path)}

    def alive() -> list[str]:
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdecimal() and str(tmp_path).encode() in (entry / "environ").read_bytes():
                    found.append(entry.name)
        return found

    before = semaphores()
    command = [sys.executable, "-c", READS, str(tmp_path)]
    report = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, **mark})
    assert report.stdout.readline() == b"1\n"
    assert len(alive()) >= 2  # the report, and at least one of the processes that read for it
    report.kill()
    report.communicate()
    wait_until(lambda: not alive())
    assert semaphores() <= before


def test_changed_lines_count_both_sides_of_every_file() -> None:
    assert count_changed_lines({"a": b"1\n2\n3\n"}, {"a": b"1\n5\n3\n", "b": b"x\n"}) == 3
    assert count_changed_lines({"a": b"1\n"}, {"a": b"1\n"}) == 0
    big = b"".join(b"%d\n" % i for i in range(15_000))
    assert count_changed_lines({"a": big}, {"a": big + b"more\n"}) == 1


def mixed(runs: Path) -> list[str]:
    return [mixture.what for mixture in mixtures(load_runs([runs]).runs)]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"budget": 64}, "episode budget"),
        ({"policy_scope": "submit"}, "policy scope"),
        ({"split": "split-2"}, "held-out split"),
        ({"fingerprint": {"numpy": "1.26.4"}}, "fingerprint"),
        ({"jail": "none"}, "jail"),
        ({"hidden_isolation": "shared"}, "hidden isolation"),
        ({"hidden_isolation": "waived"}, "hidden isolation"),
        ({"hidden_cases": "per_run"}, "hidden cases"),
    ],
)
def test_runs_that_are_no_fair_comparison_are_refused(tmp_path: Path, change: dict, what: str) -> None:
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS, entry="Agent B", **change)
    with pytest.raises(MixedRunsError, match=what):
        study([tmp_path])
    assert what in [mixture.what for mixture in study([tmp_path], allow_mixed=True).mixtures]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"observations": "lists"}, "observation form"),
        ({"finish": "budget"}, "finish rule"),
        ({"profile": "published"}, "profile"),
        ({"max_episodes_per_submit": 1}, "episodes a submit"),
        ({"limits": {"cpu_s": 1.0}}, "policy limits"),
        ({"video": "all"}, "videos in feedback"),
        ({"feedback": "scores"}, "feedback detail"),
        ({"hidden_evaluation": "pool"}, "hidden evaluation"),
        ({"agents_md": "sha256:" + "a" * 64}, "text of AGENTS.md"),
    ],
)
def test_runs_whose_agents_had_other_means_are_refused(tmp_path: Path, change: dict, what: str) -> None:
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS, entry="Agent B", change={"experiment_dimensions": change})
    assert mixed(tmp_path) == [what]


@pytest.mark.parametrize(
    ("what", "field", "limits", "other"),
    [
        ("model limits", "model_use", {"max_requests": 5000, "max_tokens": 10**8}, {"max_requests": 9}),
        ("agent limits", "resources", {"cpus": 2.0, "disk_bytes": 10**10}, {"cpus": None}),
    ],
)
def test_limits_must_agree_among_agents_that_have_any(
    tmp_path: Path, what: str, field: str, limits: dict[str, Any], other: dict[str, Any]
) -> None:
    for entry, given in (("A", limits), ("B", limits), ("C", {**limits, **other}), ("D", None)):
        use = given and {"metering": "relay", "limits": given}
        write_run(tmp_path, VERSIONS, entry=entry, change={"agent": {field: use}})
    runs = load_runs([tmp_path]).runs
    (mixture,) = mixtures(runs)
    assert (mixture.what, list(mixture.values.values())) == (what, [2, 1])
    assert mixtures([run for run in runs if run.entry != "C"]) == []


def test_prompts_must_agree_within_an_entry_and_may_differ_between_entries(tmp_path: Path) -> None:
    for entry, digest in (("Agent A", ""), ("Agent B", "a"), ("Agent B", "b")):
        prompts = {"agent": {"prompts": digest and f"sha256:{digest * 64}"}}
        write_run(tmp_path, VERSIONS, entry=entry, exp_id=f"e{digest}", change=prompts)
    runs = load_runs([tmp_path]).runs
    (mixture,) = mixtures(runs)
    assert mixture.what == "prompts"
    assert "Agent B" in mixture.where
    assert mixtures([run for run in runs if "b" not in run.record.agent.prompts[7:]]) == []


def test_a_run_continued_by_other_versions_is_set_apart(tmp_path: Path) -> None:
    overrides = {"versions": {"fingerprint_overrides": ["a → b: the old workers are gone"]}}
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS, entry="Agent B", change=overrides)
    (mixture,) = mixtures(load_runs([tmp_path]).runs)
    assert mixture.what == "fingerprint"
    assert mixture.values == {"none": 1, "then a → b: the old workers are gone": 1}


def test_an_error_names_five_values_and_five_runs_of_each(tmp_path: Path) -> None:
    for number in range(7):
        write_run(tmp_path, VERSIONS, entry=f"same {number}")
        write_run(tmp_path, VERSIONS, entry=f"other {number}", budget=900 + number)
    with pytest.raises(MixedRunsError) as error:
        study([tmp_path])
    text = str(error.value)
    assert text.count("    90") == 4
    assert "    and 3 more values" in text
    (same,) = (line for line in text.splitlines() if line.endswith(" and 2 more"))
    assert same.count(str(tmp_path)) == 5


def test_runs_without_a_record_of_isolation_are_mixed_only_on_request(tmp_path: Path) -> None:
    before: dict[str, Any] = {"hidden_isolation": ..., "experiment_dimensions": {"hidden_cases": ...}}
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS, entry="Agent B", change=before)
    with pytest.raises(MixedRunsError, match=UNKNOWN_ISOLATION):
        study([tmp_path])
    assert [mixture.values for mixture in study([tmp_path], allow_mixed=True).mixtures] == [
        {"exclusive": 1, "unknown": 1}
    ]
    # One that was shared is no more comparable for it.
    write_run(tmp_path, VERSIONS, entry="Agent C", hidden_isolation="shared")
    with pytest.raises(MixedRunsError, match="hidden isolation on core16: exclusive"):
        study([tmp_path])
    assert len(study([tmp_path], allow_mixed=True).mixtures) == 2


@pytest.mark.parametrize(
    "others",
    [
        [{"hidden_isolation": "unknown"}, {"hidden_isolation": "unknown", "entry": "Agent B"}],
        [  # runs with hidden cases of their own differ in them by design
            {
                "exp_id": f"e{number}",
                "hidden_cases": "per_run",
                "change": {"versions": {"data_valid_hash": f"v{number}", "data_heldout_hash": f"h{number}"}},
            }
            for number in range(2)
        ],
        [{}, {"entry": "Agent B"}, {"env": "gym/ant5", "fingerprint": {"numpy": "2", "mujoco": "3.10.0"}}],
    ],
)
def test_runs_that_differ_in_nothing_that_counts_are_compared(tmp_path: Path, others: list[dict]) -> None:
    for other in others:
        write_run(tmp_path, VERSIONS, **other)
    assert mixed(tmp_path) == []


OF_THE_ENVIRONMENT = {
    "python": "3.11",
    "numpy": "2.4.6",
    "adapter": "1.1+bb",
    "definition": "dd",
    "evopolicy-worker": "0.2+cc",
    "cpu": "x",
}


@pytest.mark.parametrize(
    ("there", "here", "mixed_by"),
    [
        (OF_THE_ENVIRONMENT, OF_THE_ENVIRONMENT | {"evopolicy-worker": "0.3", "adapter": "1.1+ee"}, []),
        (OF_THE_ENVIRONMENT | {"numpy": "1.26"}, OF_THE_ENVIRONMENT, ["fingerprint"]),
        (OF_THE_ENVIRONMENT, OF_THE_ENVIRONMENT | {"adapter": "1.2+bb"}, ["fingerprint"]),
        (OF_THE_ENVIRONMENT, OF_THE_ENVIRONMENT | {"definition": "ff"}, ["fingerprint"]),
    ],
)
def test_only_what_decides_an_environments_numbers_is_compared(
    tmp_path: Path, there: dict[str, str], here: dict[str, str], mixed_by: list[str]
) -> None:
    write_run(tmp_path, VERSIONS, fingerprint=there)
    write_run(tmp_path, VERSIONS, entry="Agent B", fingerprint=here)
    assert mixed(tmp_path) == mixed_by


@pytest.mark.parametrize(
    ("env", "mixed_by"),
    [("gym/acrobot", []), ("gymnasium/MiniGrid-DoorKey-16x16-v0", ["step limit"])],
)
def test_step_limits_are_compared_where_an_environment_has_two(
    tmp_path: Path, env: str, mixed_by: list[str]
) -> None:
    write_run(tmp_path, VERSIONS, env=env)
    change = {"experiment_dimensions": {"step_limit": "published"}}
    write_run(tmp_path, VERSIONS, env=env, entry="Agent B", change=change)
    assert mixed(tmp_path) == mixed_by
