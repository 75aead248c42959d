"""Run directories in: what is read, and what is left out with which reason."""

from __future__ import annotations

import contextlib
import json
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
from evopolicy_results.reading.comparability import IN_QUESTION, UNKNOWN_ISOLATION, MixedRunsError, mixtures
from evopolicy_results.reading.parallel import Processes
from evopolicy_results.reading.reader import count_changed_lines, find_run_dirs, load_runs, read_run
from evopolicy_results.reading.records import rows
from evopolicy_results.reading.rescored import rescored
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
    assert run.selected is not None
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


def test_a_replay_is_left_out_as_no_run_of_its_own(tmp_path: Path) -> None:
    folder = write_run(tmp_path, VERSIONS)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "replay_of": "r-1"}))
    (left,) = load_runs([tmp_path]).left_out
    assert left.reason == "a replay of run r-1, and no run of its own"


def test_unknown_fields_are_skipped(tmp_path: Path) -> None:
    folder = write_run(tmp_path, VERSIONS)
    record = json.loads((folder / "run.json").read_text())
    record["mood"] = {"of": "the day"}
    (folder / "run.json").write_text(json.dumps(record))
    assert read_run(folder).score == -95.0


@pytest.mark.parametrize("name", ["workspace", "checkpoints", "logs_agent"])
@pytest.mark.parametrize("place", ["/etc", "../other", "logs/../../other"])
def test_a_run_that_names_folders_outside_its_own_is_left_out(tmp_path: Path, name: str, place: str) -> None:
    folder = write_run(tmp_path, VERSIONS)
    record = json.loads((folder / "run.json").read_text())
    record["artifacts"][name] = place
    (folder / "run.json").write_text(json.dumps(record))
    found = load_runs([tmp_path])
    assert found.runs == ()
    (left,) = found.left_out
    assert f"artifacts.{name} is outside the run directory" in left.reason


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


def damage(folder: Path, how: str) -> None:
    path = folder / "run.json"
    record = json.loads(path.read_text())
    match how:
        case "no run.json":
            path.unlink()
        case "half a run.json":
            path.write_bytes(path.read_bytes()[:500])
        case "empty":
            path.write_bytes(b"")
        case "not utf-8":
            path.write_bytes(b"\xff\xfe{}")
        case "wrong type":
            record["outcome"]["final_score"] = "high"
            path.write_text(json.dumps(record))
        case "newer schema":
            record["schema_version"] = 99
            path.write_text(json.dumps(record))
        case "completed without score":
            record["outcome"]["final_score"] = None
            path.write_text(json.dumps(record))
        case "selected submit is gone":
            record["outcome"]["best_submit_index"] = 77
            path.write_text(json.dumps(record))
        case "truncated summary":
            (folder / "workspace/feedback/submit_000/summary.json").write_text('{"schema_version": 1,')
        case "damaged metrics":
            (folder / "checkpoints/submit_000/_meta.json").write_text("[]")
        case "run.json is a folder":
            path.unlink()
            path.mkdir()
        case "deeply nested":
            path.write_text("[" * 200_000)


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("no run.json", "unfinished"),
        ("half a run.json", "run.json"),
        ("empty", "run.json"),
        ("not utf-8", "run.json"),
        ("wrong type", "final_score"),
        ("newer schema", "schema_version 99"),
        ("completed without score", "no final_score"),
        ("selected submit is gone", "selected submit 77"),
        ("truncated summary", "submit_000/summary.json"),
        ("damaged metrics", "_meta.json"),
        ("run.json is a folder", "not a regular file"),
        ("deeply nested", "run.json"),
    ],
)
def test_damaged_run_is_left_out_with_its_reason(tmp_path: Path, how: str, reason: str) -> None:
    good = write_run(tmp_path, VERSIONS, exp_id="good")
    bad = write_run(tmp_path, VERSIONS, exp_id="bad")
    damage(bad, how)
    loaded = load_runs([tmp_path])
    assert [run.path for run in loaded.runs] == [good]
    assert [left.path for left in loaded.left_out] == [bad]
    assert reason in loaded.left_out[0].reason


def test_a_cancelled_run_is_left_out_as_what_it_is(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS, status="cancelled")
    (left,) = load_runs([tmp_path]).left_out
    assert "was cancelled" in left.reason


def test_run_that_ended_in_an_error_is_left_out(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS, status="error")
    loaded = load_runs([tmp_path])
    assert not loaded.runs
    assert "worker lost" in loaded.left_out[0].reason


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
    found = Processes(2).map(operator.call, items, lambda item, why: (item, why))
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
    assert report.stdout is not None
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


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"budget": 64}, "episode budget"),
        ({"scope": "submit"}, "policy scope"),
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
        ({"agents_md": "sha256:" + "a" * 64}, "text of AGENTS.md"),
    ],
)
def test_runs_whose_agents_had_other_means_are_refused(tmp_path: Path, change: dict, what: str) -> None:
    write_run(tmp_path, VERSIONS)
    run = write_run(tmp_path, VERSIONS, entry="Agent B")
    record = json.loads((run / "run.json").read_text())
    record["experiment_dimensions"] |= change
    (run / "run.json").write_text(json.dumps(record))
    assert [mixture.what for mixture in mixtures(load_runs([tmp_path]).runs)] == [what]


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
        run = write_run(tmp_path, VERSIONS, entry=entry)
        record = json.loads((run / "run.json").read_text())
        record["agent"][field] = given and {"metering": "relay", "limits": given}
        (run / "run.json").write_text(json.dumps(record))
    runs = load_runs([tmp_path]).runs
    (mixture,) = mixtures(runs)
    assert (mixture.what, list(mixture.values.values())) == (what, [2, 1])
    assert mixtures([run for run in runs if run.entry != "C"]) == []


def test_prompts_must_agree_within_an_entry_and_may_differ_between_entries(tmp_path: Path) -> None:
    for entry, digest in (("Agent A", ""), ("Agent B", "a"), ("Agent B", "b")):
        run = write_run(tmp_path, VERSIONS, entry=entry, exp_id=f"e{digest}")
        record = json.loads((run / "run.json").read_text())
        record["agent"]["prompts"] = digest and f"sha256:{digest * 64}"
        (run / "run.json").write_text(json.dumps(record))
    runs = load_runs([tmp_path]).runs
    (mixture,) = mixtures(runs)
    assert mixture.what == "prompts"
    assert "Agent B" in mixture.where
    assert mixtures([run for run in runs if "b" not in run.record.agent.prompts[7:]]) == []


@pytest.mark.parametrize(
    ("found", "refused"),
    [
        ({"share": 0.05, "sampled": 4, "audited": 4, "agreed": 4}, False),
        ({"share": 0.05, "sampled": 4, "not_audited": {"one worker only": 4}}, False),
        ({"share": 0.05, "sampled": 4, "audited": 4, "agreed": 4, "forgers": {"w": 0}}, False),
        ({"share": 0.05, "sampled": 4, "audited": 4, "agreed": 3, "disputed": 1}, True),
        ({"share": 0.0, "forgers": {"w": 7}}, True),
    ],
)
def test_a_run_that_its_audits_put_in_question_is_refused(tmp_path: Path, found: dict, refused: bool) -> None:
    run = write_run(tmp_path, VERSIONS)
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, "audit": found}))
    runs = load_runs([tmp_path]).runs
    assert [mixture.what for mixture in mixtures(runs)] == [IN_QUESTION] * refused


def test_a_run_continued_by_other_versions_is_set_apart(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS)
    run = write_run(tmp_path, VERSIONS, entry="Agent B")
    record = json.loads((run / "run.json").read_text())
    record["versions"]["fingerprint_overrides"] = ["a → b: the old workers are gone"]
    (run / "run.json").write_text(json.dumps(record))
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


def test_runs_from_before_isolation_was_recorded_are_mixed_only_by_name(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS)
    old = write_run(tmp_path, VERSIONS, entry="Agent B")
    record = json.loads((old / "run.json").read_text())
    del record["hidden_isolation"], record["experiment_dimensions"]["hidden_cases"]
    (old / "run.json").write_text(json.dumps(record))
    for refused in ({}, {"allow_mixed": True}):
        with pytest.raises(MixedRunsError, match=UNKNOWN_ISOLATION):
            study([tmp_path], **refused)
    assert [mixture.values for mixture in study([tmp_path], allow_unknown=True).mixtures] == [
        {"exclusive": 1, "unknown": 1}
    ]
    # One that was shared is no more comparable for it.
    write_run(tmp_path, VERSIONS, entry="Agent C", hidden_isolation="shared")
    with pytest.raises(MixedRunsError, match="hidden isolation on core16: exclusive"):
        study([tmp_path], allow_unknown=True)
    assert len(study([tmp_path], allow_unknown=True, allow_mixed=True).mixtures) == 2


def test_runs_that_all_do_not_tell_their_isolation_are_compared(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS, hidden_isolation="unknown")
    write_run(tmp_path, VERSIONS, entry="Agent B", hidden_isolation="unknown")
    assert mixtures(load_runs([tmp_path]).runs) == []


def test_runs_with_hidden_cases_of_their_own_differ_in_them_by_design(tmp_path: Path) -> None:
    for number in range(2):
        run = write_run(tmp_path, VERSIONS, exp_id=f"e{number}", hidden_cases="per_run")
        record = json.loads((run / "run.json").read_text())
        record["versions"] |= {"data_valid_hash": f"v{number}", "data_heldout_hash": f"h{number}"}
        (run / "run.json").write_text(json.dumps(record))
    assert mixtures(load_runs([tmp_path]).runs) == []


def test_equal_runs_and_other_environments_splits_are_no_mixture(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS, entry="Agent B")
    write_run(tmp_path, VERSIONS, env="gym/ant5", fingerprint={"numpy": "2.4.6", "mujoco": "3.10.0"})
    assert mixtures(load_runs([tmp_path]).runs) == []


OF_THE_WORKER = {
    "python": "3.11",
    "numpy": "2.4.6",
    "mujoco": "3.10.0",
    "evopolicy-worker": "0.1+aa",
    "cpu": "x",
}
OF_THE_ENVIRONMENT = {
    "python": "3.11",
    "numpy": "2.4.6",
    "adapter": "1.1+bb",
    "definition": "dd",
    "evopolicy-worker": "0.2+cc",
    "cpu": "x",
}


@pytest.mark.parametrize(
    ("there", "here", "mixed"),
    [
        (OF_THE_WORKER, OF_THE_ENVIRONMENT, False),
        (OF_THE_ENVIRONMENT, OF_THE_ENVIRONMENT | {"evopolicy-worker": "0.3", "adapter": "1.1+ee"}, False),
        (OF_THE_WORKER | {"numpy": "1.26"}, OF_THE_ENVIRONMENT, True),
        (OF_THE_WORKER, OF_THE_ENVIRONMENT | {"adapter": "1.2+bb"}, True),
        (OF_THE_ENVIRONMENT, OF_THE_ENVIRONMENT | {"definition": "ff"}, True),
        (OF_THE_WORKER, OF_THE_WORKER | {"evopolicy-worker": "0.1+bb"}, True),
    ],
)
def test_runs_of_before_fingerprints_of_single_environments_stay_comparable(
    tmp_path: Path, there: dict[str, str], here: dict[str, str], mixed: bool
) -> None:
    write_run(tmp_path, VERSIONS, fingerprint=there)
    write_run(tmp_path, VERSIONS, entry="Agent B", fingerprint=here)
    found = [mixture.what for mixture in mixtures(load_runs([tmp_path]).runs)]
    assert found == (["fingerprint"] if mixed else [])


def test_step_limits_are_compared_where_an_environment_has_two(tmp_path: Path) -> None:
    for env, found in (("gym/acrobot", []), ("gymnasium/MiniGrid-DoorKey-16x16-v0", ["step limit"])):
        runs = tmp_path / env
        write_run(runs, VERSIONS, env=env)
        run = write_run(runs, VERSIONS, env=env, entry="Agent B")
        record = json.loads((run / "run.json").read_text())
        record["experiment_dimensions"]["step_limit"] = "published"
        (run / "run.json").write_text(json.dumps(record))
        assert [mixture.what for mixture in mixtures(load_runs([runs]).runs)] == found
