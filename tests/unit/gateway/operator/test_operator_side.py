"""Options as settings, control lines, `run.json` from a finished run, what watchers print, paths of policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from documents import parse
from hypothesis import given
from hypothesis import strategies as st
from invented.policies import Version
from invented.run_dirs import write_run
from rigs.finished_run import finished, plan_in, record_in

from evopolicy_common.errors import ConfigError, ProtocolError
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, ResourceLimits
from evopolicy_common.messages.run_settings import PUBLISHED, off_profile
from evopolicy_common.records.run_record import RejectedSubmit, decode_run_record, encode_run_record
from evopolicy_gateway.cli.play import _unjailed
from evopolicy_gateway.declared import declared, set_values
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.operator.cluster import ChosenCluster
from evopolicy_gateway.operator.trials import policy_bundle
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import TrainProgress
from evopolicy_gateway.run import record
from evopolicy_gateway.run.run_options import (
    ClusterOptions,
    RunOptions,
    cases_of,
    limits_of,
    one_environment,
    packages_for,
)
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.run_folder.layout import Staged


def test_a_missing_cli_is_refused_before_the_run_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="no program 'claude' on the PATH; install it with: "):
        plan_in(tmp_path, agent="claude-code").claim()
    assert not list(tmp_path.iterdir())


def test_packages_that_somebody_elses_run_names_are_refused_with_its_file(tmp_path: Path) -> None:
    folder = Path(write_run(tmp_path, [Version({"policy.py": "x = 1"}, (1.0, 2.0), 0.5)]))
    record = decode_run_record((folder / "run.json").read_bytes())
    policy = folder / "checkpoints" / "submit_000"
    for named, expected in (("scipy", ("scipy",)), ("", ())):
        record.versions.fingerprint["policy"] = named
        (folder / "run.json").write_bytes(encode_run_record(record))
        assert packages_for(policy, None) == expected
    for named in ("scipy,x; touch /tmp/y", "no-such-package", "evopolicy"):
        record.versions.fingerprint["policy"] = named
        (folder / "run.json").write_bytes(encode_run_record(record))
        with pytest.raises(ConfigError, match=r"run\.json names packages .*--policy-package names others"):
            packages_for(policy, None)
    assert packages_for(policy, ["scipy"]) == ("scipy",)


STAGED = Staged(agents_md_hash="h", rules_hash="r", initial_policy_hash="i")


def test_a_completed_run_is_recorded_with_all_its_numbers(tmp_path: Path) -> None:
    rejected = [RejectedSubmit(status="budget_invalid", message="no", after_submits=1)]
    times = Times(open_s=9.0, in_flight_s=4.0, feedback_s=0.5)
    counted = {"steps": 10, "action_invalid": 3}
    known = {"rejected_submits": tuple(rejected), "transitions": counted}
    record = record_in(plan_in(tmp_path), finished(), STAGED, times, **known)
    assert record.outcome.auxiliary["transitions"] == {"steps": 10, "action_invalid": 3}
    assert decode_run_record(encode_run_record(record)) == record
    assert record.outcome.final_score == record.outcome.heldout_mean_return == 2.0
    assert record.outcome.heldout_std_return == 1.0
    assert record.outcome.val_scores == {"0": 1.0, "1": 1.5}
    assert record.outcome.quarantined_submits == (2,)
    assert record.outcome.random_reference is not None
    assert record.outcome.random_reference.mean_return == 0.5
    assert (record.agent.turns, record.agent.retries) == (2, 1)
    assert record.agent.settings["effort"] == "high"
    timing = record.timing
    assert (timing.wall_time_seconds, timing.agent_s, timing.feedback_s) == (12.5, 5.0, 0.5)
    assert [one.message for one in record.rejected_submits] == ["no"]
    assert record.experiment_dimensions.n_heldout == 2
    assert record.versions.fingerprint["numpy"] == "2.4"
    assert record.versions.fingerprint_overrides == ("a → b: the old workers are gone",)


def test_an_environment_that_does_not_repeat_itself_is_marked_in_the_record(tmp_path: Path) -> None:
    for deterministic in (True, False):
        record = record_in(plan_in(tmp_path), finished(deterministic=deterministic))
        assert record.versions.env_deterministic is deterministic


@pytest.mark.parametrize("status", ["no_ok_submit", "error", "cancelled"])
def test_a_run_without_a_result_has_no_score(tmp_path: Path, status: str) -> None:
    done = finished(status=status, final_score=None, best_submit_index=None, heldout_returns=(), submits=())
    outcome = record_in(plan_in(tmp_path), done).outcome
    assert outcome.status == status
    assert outcome.final_score == (0.0 if status == "no_ok_submit" else None)
    assert outcome.score is None
    assert outcome.val_scores is None
    assert outcome.heldout_returns == ()


@pytest.mark.parametrize(
    ("why", "status", "error"),
    [
        (None, "cancelled", record.CANCELLED),
        (record.INTERRUPTED, "cancelled", record.INTERRUPTED),
        ("the agent's folder is gone", "error", "the agent's folder is gone"),
    ],
)
async def test_a_cancelled_run_has_its_reason_as_error(
    tmp_path: Path, why: str | None, status: str, error: str
) -> None:
    plan = plan_in(tmp_path)
    plan.claim()
    done = finished(
        status="cancelled", final_score=None, best_submit_index=None, heldout_returns=(), submits=()
    )
    plan.folder.harness_log.parent.mkdir()
    operations: Any = None  # nothing is fetched without a submit
    written = await record.write(plan.folder, plan, done, operations, Times(), [].append, why)
    assert (written.outcome.status, written.outcome.error) == (status, error)
    assert decode_run_record(plan.folder.run_json.read_bytes()) == written


@pytest.mark.parametrize(
    ("status", "named"), [("no_ok_submit", "a finished"), ("error", "a failed"), ("cancelled", "a cancelled")]
)
def test_a_taken_folder_says_what_kind_of_run_it_holds(tmp_path: Path, status: str, named: str) -> None:
    plan = plan_in(tmp_path)
    plan.claim()
    done = finished(status=status, final_score=None, best_submit_index=None, heldout_returns=(), submits=())
    record = record_in(plan, done)
    plan.folder.run_json.write_bytes(encode_run_record(record))
    with pytest.raises(ConfigError, match=f"holds {named} run; choose another --exp-id"):
        plan.claim()


def test_a_runs_folder_is_claimed_once_and_replaced_only_on_demand(tmp_path: Path) -> None:
    first = plan_in(tmp_path)
    first.claim()
    first.folder.run_json.write_text("{}")
    with pytest.raises(ConfigError, match=r"finished run.*--overwrite"):
        first.claim()
    plan_in(tmp_path, overwrite=True).claim()
    assert list(first.folder.root.iterdir()) == []
    (first.folder.root / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match="not a run's folder"):
        plan_in(tmp_path, overwrite=True).claim()
    assert (first.folder.root / "thesis.tex").exists()
    first.folder.asked.touch()  # as a command leaves it that was killed while it removed a run
    plan_in(tmp_path, overwrite=True).claim()
    assert list(first.folder.root.iterdir()) == []


def test_limits_are_the_usual_ones_but_for_those_named() -> None:
    limits = limits_of(["act_wall_s=2.5", "memory_bytes=2e9", "submit_wall_s=60"])
    assert limits == ResourceLimits(act_wall_s=2.5, memory_bytes=2_000_000_000, submit_wall_s=60.0)
    assert isinstance(limits.memory_bytes, int)
    wrong_ones = ("act_wall_s", "act_wall=1", "cpu_s=inf", *(f"act_wall_s={x}" for x in ("x", 0, -1, "nan")))
    for wrong in wrong_ones:
        with pytest.raises(ConfigError, match="--limit"):
            limits_of([wrong])
    for name, most in (*LARGEST_LIMITS.items(), ("memory_bytes", LARGEST_LIMIT)):
        assert getattr(limits_of([f"{name}={most}"]), name) == most
        with pytest.raises(ConfigError, match="at most"):
            limits_of([f"{name}={2 * most}"])


@given(st.lists(st.integers(0, 10**6 - 1), min_size=1, max_size=20))
def test_cases_are_read_as_ids_and_ranges(ids: list[int]) -> None:
    assert cases_of(",".join(map(str, ids))) == tuple(ids)


def test_wrong_option_values_name_the_option() -> None:
    for wrong in ("", "3-1", "x", "0-99999999"):
        with pytest.raises(ConfigError, match="--cases"):
            cases_of(wrong)
    with pytest.raises(ConfigError, match="16 environments"):
        one_environment("core16")
    words = ["--profile", "p", "--tier", "docker", "--video", "on"]
    for option, text in zip(words[::2], words[1::2], strict=True):
        with pytest.raises(typer.BadParameter, match=f"'{text}' is not one of"):
            parse(["evopolicy", "run", "--env", "toy/line", "--agent", "evolve", option, text])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("policy_scope=run", "use one of 'episode', 'submit'"),
        ("finish=late", "use one of 'early', 'budget'"),
        ("min_episodes=0", "Expected `int` >= 1"),
        ("agent_cpus=many", "Expected `float"),
        ("polcy_scope=submit", "did you mean policy_scope="),
        ("budget=3", "write NAME=VALUE with one of"),
        ("policy_scope", "write NAME=VALUE"),
    ],
)
def test_a_wrong_further_setting_names_the_remedy(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=f"--set {text}: .*{problem}"):
        set_values(declared(RunOptions), [text])


def test_further_settings_are_those_of_suite_files() -> None:
    given = set_values(declared(RunOptions), ["policy-scope=submit", "min_episodes=4", "prompts=p.toml"])
    assert given == {"policy_scope": "submit", "min_episodes": 4, "prompts": Path("p.toml")}


def test_profile_published_makes_every_published_choice_and_takes_no_other() -> None:
    own = RunOptions(agent="evolve").settings("toy/line", "t")
    assert (own.profile, own.policy_scope, own.observations) == ("own", "episode", "arrays")
    assert (own.finish, own.step_limit, own.hidden_cases) == ("early", "published", "shared")
    published = RunOptions(agent="evolve", profile="published", finish="budget").settings("toy/line", "t")
    assert off_profile(published) == ""
    assert {name: getattr(published, name) for name in PUBLISHED} == PUBLISHED
    for name, value in (("observations", "arrays"), ("policy_scope", "episode"), ("hidden_cases", "per-run")):
        with pytest.raises(ConfigError, match=f"profile published has {name} = "):
            RunOptions(agent="evolve", profile="published", **{name: value}).settings("toy/line", "t")
    assert (published.n_validation, published.n_heldout) == (16, 32)
    data = RunOptions(agent="evolve", profile="published-data", heldout=256).settings("toy/line", "t")
    assert (data.n_validation, data.n_heldout, off_profile(data)) == (64, 256, "")
    with pytest.raises(ConfigError, match="profile published has n_heldout = 32, but 256 was given"):
        RunOptions(agent="evolve", profile="published", heldout=256).settings("toy/line", "t")
    with pytest.raises(ConfigError, match="give --data FOLDER"):
        ChosenCluster(local=ClusterOptions()).check_cases([published])
    ChosenCluster(local=ClusterOptions()).check_cases([own])
    ChosenCluster(local=ClusterOptions(data=Path("data"))).check_cases([published])


def test_control_lines_come_back_as_they_were_and_nothing_else_does() -> None:
    progress = TrainProgress(episode_budget=8, remaining_budget=3, n_submits=1, last_mean=1.5)
    assert child_messages.event_of(child_messages.line(progress)) == progress
    for junk in (b"", b"{}", b'{"event": "other"}', b"plain text"):
        with pytest.raises(ProtocolError):
            child_messages.event_of(junk)


OPEN = [("open-network", "bwrap"), ("none", "bwrap"), ("bwrap", "none")]


@pytest.mark.parametrize(
    ("jail", "tier", "exposed"), [("bwrap", "bwrap", False), *((*each, True) for each in OPEN)]
)
def test_agents_without_a_jail_may_read_the_state(
    jail: Any, tier: Any, exposed: bool, tmp_path: Path
) -> None:
    settings = RunOptions(agent="evolve", tier=tier).settings("toy/line", "t")
    assert _unjailed([plan_in(tmp_path, settings, jail=JailSettings(mode=jail))]) == exposed


@pytest.mark.parametrize(
    ("name", "problem"),
    [("empty", "holds no policy.py"), ("policy.py", "is a file"), ("absent", "there is no folder")],
)
def test_a_path_without_a_policy_is_refused_with_the_remedy(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "policy.py").touch()
    with pytest.raises(ConfigError) as refused:
        policy_bundle(tmp_path / name)
    assert problem in str(refused.value)
    assert str(tmp_path / name) in str(refused.value)
    assert "name a folder with policy.py in it" in str(refused.value)
