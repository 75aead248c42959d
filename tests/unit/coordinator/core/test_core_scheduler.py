"""The scheduler: priorities, fair share, batches, warmth, placement, drain."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import msgspec
import pytest
from rigs.core_rig import BUNDLE, ENV, Rig, describe, outcome_of, result, split_of

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_coordinator.core.runs.waits import waits_for_workers
from evopolicy_coordinator.core.workers import scheduler
from evopolicy_coordinator.server.reason_texts import env_failure, reason_text
from evopolicy_worker.environments.interface.fingerprint import PACKAGES


def test_train_goes_before_validation_and_stops_none(rig: Rig) -> None:
    session = rig.begin(0, worker={"slots": 4}, run={"n_valid": 8})
    rig.play(session, *rig.poll(session, 1))
    rig.close("r1")
    rig.create("r2", hidden_from=9000)
    (hidden,) = rig.poll(session, 1)
    rig.submit(0, 1, run="r2", key="x")
    train = rig.poll(session, 3)
    assert [split_of(lease.job) for lease in train][:2] == ["train", "train"]
    assert rig.beat(session, hidden, *train).cancelled == ()
    rig.play(session, *train)
    assert {split_of(lease.job) for lease in rig.poll(session, 3)} <= {"validation", "random"}


MANY = {"budget": 64, "most": 64}


def leased(rig: Rig, session: str, rounds: int) -> Counter[str]:
    """Leases of each run, while one worker plays."""
    got: Counter[str] = Counter()
    for _ in range(rounds):
        leases = rig.poll(session, 2)
        got.update(lease.job.job_id.split("/")[0] for lease in leases)
        rig.play(session, *leases)
    return got


def test_two_runs_share_the_slots_whatever_they_have_waiting(rig: Rig) -> None:
    session = rig.begin(*range(40), run=MANY)
    rig.create("r2", **MANY)
    rig.submit(*range(8), run="r2", key="x")
    assert leased(rig, session, 8) == {"r1": 8, "r2": 8}


def test_a_worker_cannot_forge_the_fair_shares_time(rig: Rig) -> None:
    session = rig.begin(*range(40), run=MANY)
    rig.create("r2", **MANY)
    rig.submit(*range(40), run="r2", key="x")
    got: Counter[str] = Counter()
    for _ in range(8):
        for lease in rig.poll(session, 2):
            run = lease.job.job_id.split("/")[0]
            got[run] += 1
            wall_s = 1e99 if run == "r1" else 1.0
            outcomes = tuple(
                msgspec.structs.replace(outcome_of(spec.index), wall_s=wall_s) for spec in lease.job.episodes
            )
            rig.report_results(session, result(lease, "done", episodes=outcomes))
    assert got == {"r1": 8, "r2": 8}


def test_a_run_that_was_idle_earns_nothing_by_it(rig: Rig) -> None:
    session = rig.begin(*range(40), run=MANY)
    leased(rig, session, 10)
    rig.create("r2", **MANY)
    rig.submit(*range(20), run="r2", key="x")
    got = leased(rig, session, 5)
    assert abs(got["r1"] - got["r2"]) <= 2


def test_a_submit_spreads_over_all_waiting_workers(rig: Rig) -> None:
    sessions = [rig.register(f"w{index}", slots=2) for index in range(3)]
    rig.create()
    for session in sessions:
        assert rig.poll(session, 4, wait_s=9.0) is None
    requests = list(range(rig._requests - 2, rig._requests + 1))
    rig.submit(*range(6))
    given = [len(rig.replies[request].leases) for request in requests]
    assert given == [2, 2, 2]


def test_short_episodes_come_in_batches_and_no_idle_worker_goes_without(rig: Rig) -> None:
    first, second = rig.register("w1", slots=1), rig.register("w2", slots=1)
    rig.create(budget=128, most=128)
    rig.core.state.runs["r1"].flow.episode_s = 0.005
    rig.submit(*range(20))
    assert len(rig.poll(first, 2)) == 10  # half of what waits, for half of the slots
    assert len(rig.poll(second, 2)) > 1


def test_long_episodes_are_leased_to_free_slots_only(rig: Rig) -> None:
    session = rig.begin(*range(8), worker={"slots": 2})
    leases = rig.poll(session, 4)
    assert len(leases) == 2
    assert rig.poll(session, 2, wait_s=9.0) is None
    request = rig._requests
    rig.play(session, leases[0])
    assert len(rig.replies[request].leases) == 1


def test_new_work_goes_to_the_worker_that_has_its_bundle_warm(rig: Rig) -> None:
    cold, warm = rig.register("w1"), rig.register("w2")
    rig.create()
    rig.poll(cold, 2, wait_s=9.0)
    rig.poll(warm, 2, wait_s=9.0, warm_bundles=(BUNDLE,))
    request = rig._requests
    rig.submit(0)
    assert len(rig.replies[request].leases) == 1


def test_a_worker_gets_only_what_it_can_play(rig: Rig) -> None:
    rig.begin(0)
    for other in (rig.register("w2", envs=("toy/maze",)), rig.register("w3", tiers=("none",))):
        assert rig.poll(other) == []


def test_a_run_stays_with_its_fingerprint_class_until_an_operator_says_otherwise(rig: Rig) -> None:
    rig.begin(0)
    other = rig.register("w2", version="2")
    assert rig.poll(other) == []
    rig.pass_time(20.0)
    rig.beat(other)
    (run,) = rig.status().runs
    assert "the versions that the run started with" in run.waits_for
    worker = next(each for each in rig.status().workers if each.worker == "w2")
    assert "r1" in worker.refused
    named = worker.fingerprint
    wrong = rig.ask(operator.RepinRun, run="r1", fingerprint_class="nope", reason="x")
    assert wrong.status == "unknown_class"
    rig.ask(operator.RepinRun, run="r1", fingerprint_class=named, reason="the old host is gone")
    rig.play(other, *rig.poll(other))
    rig.finish(other)
    (override,) = rig.finished().fingerprint_overrides
    assert override.endswith(f" → {named}: the old host is gone")


def test_a_run_names_the_installations_that_played_it_and_only_those(rig: Rig) -> None:
    workers = [rig.register(name, slots=1, installation=f"{name}@1") for name in ("base", "atari")]
    rig.register("idle", installation="unused@3")
    rig.create()
    rig.submit(0, 1)
    for worker in workers:
        rig.play(worker, *rig.poll(worker, 1))
    rig.load()
    again = rig.register("atari", installation="atari@1")
    rig.close()
    for _ in range(90):
        rig.pass_time(1.0)
        rig.beat(again)
        rig.work_off(again)
    assert rig.finished().installations == ("base@1", "atari@1")


def pinned_versions(file: str) -> dict[str, str]:
    text = (Path(__file__).parents[4] / file).read_text()
    return dict(re.findall(r"^([\w-]+)==([\w.]+)$", text.lower(), re.MULTILINE))


def test_a_worker_with_the_papers_versions_is_its_own_class() -> None:
    paper = pinned_versions("deploy/paper-versions.txt")
    usual = {name: version for name, version in pinned_versions("constraints.txt").items() if name in paper}
    assert paper.keys() == usual.keys() == {"gymnasium", "highway-env", "minigrid", "mujoco"}
    assert set(paper) <= {name.lower() for name in PACKAGES}
    rig = Rig()
    rig.begin(0, worker={"packages": usual})
    other = rig.register("w2", packages=usual | paper)
    assert rig.poll(other) == []
    workers = {each.worker: each for each in rig.status().workers}
    assert workers["w1"].fingerprint != workers["w2"].fingerprint
    for name, version in paper.items():
        assert workers["w2"].versions[name] == version
        assert f"{name} {usual[name]} there, {version} here" in workers["w2"].refused["r1"]


def versioned(env: str = "toy/line", **more: Any) -> EnvironmentDescription:
    return describe(env, **({"adapter": "1.1+aa", "packages": {"numpy": "2.4"}} | more))


@pytest.mark.parametrize(
    ("more", "described"),
    [
        ({"version": "2", "packages": {"numpy": "2.4", "mujoco": "4"}}, (versioned(),)),
        ({}, (versioned(), versioned("toy/maze", adapter="1.1+bb", packages={"ale-py": "0.12"}))),
    ],
)
def test_what_plays_other_environments_makes_no_other_class_of_this_one(
    rig: Rig, more: dict[str, Any], described: tuple[EnvironmentDescription, ...]
) -> None:
    rig.begin(0, worker={"described": (versioned(),)})
    other = rig.register("w2", described=described, **more)
    assert len(rig.poll(other)) == 1


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"adapter": "1.1+cc"}, "adapter 1.1+aa there, 1.1+cc here"),
        ({"packages": {"numpy": "2.5"}}, "numpy 2.4 there, 2.5 here"),
        ({"max_episode_steps": 3}, "max_episode_steps 10 there, 3 here"),
        ({"task_text": "easier"}, "task_text  there, easier here"),
    ],
)
def test_two_definitions_of_one_environment_are_two_classes(
    rig: Rig, changed: dict[str, Any], named: str
) -> None:
    rig.begin(0, worker={"described": (versioned(),)})
    other = rig.register("w2", described=(versioned(**changed),))
    assert rig.poll(other) == []
    (worker,) = (each for each in rig.status().workers if each.worker == "w2")
    assert named in worker.refused["r1"]
    there = worker.classes["toy/line"]
    reply = rig.ask(operator.RepinRun, run="r1", fingerprint_class=there, reason="the old host is gone")
    assert reply == operator.Done()
    assert len(rig.poll(other)) == 1


def test_a_definition_is_the_same_whoever_plays_it_and_whatever_its_defaults() -> None:
    digest = versioned().digest()
    assert digest == versioned(adapter="2.1+dd", packages={}, env_version="9", renders=False).digest()
    assert digest != versioned(title="Another").digest()


@pytest.mark.parametrize(("state", "ends"), [("draining", True), ("paused", False)])
def test_a_worker_out_of_service_gets_no_work_after_restarts(
    rig: Rig, state: Literal["draining", "paused"], ends: bool
) -> None:
    session = rig.begin(0, 1)
    (lease, _) = rig.poll(session, 2)
    answer = rig.ask(operator.SetWorker, worker="w1", state=state)
    assert isinstance(answer, operator.Done)
    assert rig.beat(session, lease).drain is ends
    rig.play(session, lease)
    assert rig.poll(session, 1) == []
    rig.load()
    session = rig.register()
    rig.pass_time(5.0)
    assert rig.beat(session).drain is ends
    assert rig.poll(session) == []
    assert [each.state for each in rig.status().workers] == [state]
    rig.ask(operator.SetWorker, worker="w1", state="active")
    assert len(rig.poll(session)) == 1


@pytest.mark.parametrize("how", ["paused", "lost"])
def test_a_run_opened_without_workers_is_played_on_their_return(
    rig: Rig, how: Literal["paused", "lost"]
) -> None:
    session = rig.register()
    if how == "paused":
        rig.ask(operator.SetWorker, worker="w1", state="paused")
    else:
        rig.pass_time(60.0)
    assert [each.state for each in rig.status().workers] == [how]
    rig.create()
    rig.submit(0)
    if how == "paused":
        assert rig.poll(session) == []
        rig.ask(operator.SetWorker, worker="w1", state="active")
    assert len(rig.poll(session)) == 1


def test_a_second_poll_answers_the_first_with_no_leases(rig: Rig) -> None:
    session = rig.register()
    assert rig.poll(session, wait_s=9.0) is None
    first = rig._requests
    rig.poll(session, wait_s=9.0)
    assert rig.replies[first].leases == ()
    rig.pass_time(10.0)
    assert len(rig.core.state.timers) == 1  # the worker's own


def test_what_waits_too_long_is_named_with_what_it_waits_for() -> None:
    rig = Rig(stall_s=10.0)
    rig.register(envs=("toy/line",))
    rig.create()
    rig.submit(0)
    rig.pass_time(40.0)
    (stall,) = rig.status().stalls
    assert "r1/s0/train" in stall
    assert "a worker that offers toy/line" in stall


def test_a_run_waits_for_its_connected_workers_description_only(rig: Rig) -> None:
    rig.create()
    flow = rig.core.state.runs["r1"].flow
    rig.register("w1", envs=(), undescribed=(ENV,), tiers=("none",))
    assert reason_text(waits_for_workers(rig.core.state, flow)).startswith(f"a worker that offers {ENV}")
    rig.register("w2", envs=(), undescribed=(ENV,))
    assert reason_text(waits_for_workers(rig.core.state, flow)) == (
        f"a connected worker to describe {ENV}, as it does before its first episode"
    )
    rig.ask(operator.SetWorker, worker="w2", state="paused")
    assert reason_text(waits_for_workers(rig.core.state, flow)).endswith(": those that do are paused")
    rig.register("w3")
    assert waits_for_workers(rig.core.state, flow) is None


def test_a_run_learns_why_its_environment_failed_until_a_worker_offers_it(rig: Rig) -> None:
    rig.create()
    flow = rig.core.state.runs["r1"].flow
    rig.register("w1", envs=("toy/maze",), failed={ENV: "step 3: it raised KeyError"})
    assert env_failure(waits_for_workers(rig.core.state, flow)) == "step 3: it raised KeyError"
    (worker,) = rig.status().workers
    assert worker.failed_environments == {ENV: "step 3: it raised KeyError"}
    rig.register("w2", envs=(), undescribed=(ENV,))
    assert not env_failure(waits_for_workers(rig.core.state, flow))
    rig.register("w2", envs=())
    assert env_failure(waits_for_workers(rig.core.state, flow))
    rig.register("w1", envs=(ENV,))
    assert waits_for_workers(rig.core.state, flow) is None


def test_jobs_waiting_after_faults_are_named_with_the_last() -> None:
    rig = Rig(stall_s=0.1, retry_base_s=10.0)
    session = rig.begin(0)
    rig.report_results(session, result(rig.poll(session)[0], "failed", error="no space left on device"))
    rig.pass_time(1.0)
    (stall,) = rig.status().stalls
    assert "wait for a retry after an infrastructure failure" in stall
    assert stall.endswith("after 1 faults, the last: failed on w1: no space left on device")


def test_a_poll_read_after_its_worker_gave_up_gets_no_lease(rig: Rig) -> None:
    session = rig.begin(0, 1)
    assert rig.poll(session, 1, wait_s=10.0, waited_s=12.0) == []
    assert len(rig.poll(session, 1, wait_s=10.0, waited_s=9.0)) == 1


def test_a_parked_poll_given_up_during_a_block_gets_no_lease(rig: Rig) -> None:
    session = rig.begin()
    assert rig.poll(session, 1, wait_s=10.0) is None
    request = rig._requests
    rig.now += 14.0
    rig.submit(0)
    rig.pass_time(0.0)
    assert rig.replies[request] == wire.Leases(leases=())
    assert len(rig.poll(session, 1)) == 1


def test_a_late_read_poll_is_answered_while_its_worker_waits(rig: Rig) -> None:
    session = rig.register()
    assert rig.poll(session, 1, wait_s=10.0, waited_s=8.0) is None
    request = rig._requests
    rig.pass_time(2.5)
    assert rig.replies[request] == wire.Leases(leases=())


def test_one_answer_holds_no_more_leases_than_fit_into_a_message(rig: Rig) -> None:
    session = rig.register(slots=4096)
    rig.create(train=64, budget=2000, most=1000)
    rig.submit(*(k % 64 for k in range(1000)))
    sizes = [len(rig.poll(session, 4096)) for _ in range(5)]
    assert sizes == [scheduler.LEASES_MAX] * 3 + [1000 - 3 * scheduler.LEASES_MAX, 0]


def test_a_worker_holds_no_more_leases_than_its_heartbeat_can_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "HELD_MAX", 20)
    rig = Rig()
    session = rig.begin(*range(50), worker={"slots": 4096}, run={"train": 64, "budget": 100, "most": 100})
    first = rig.poll(session, 4096)
    assert (len(first), rig.poll(session, 4096)) == (20, [])
    rig.play(session, first[0])
    assert len(rig.poll(session, 4096)) == 1


def test_large_jobs_are_leased_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "EPISODES_MAX", 20)
    rig = Rig()
    session = rig.register(slots=64)
    for k in range(6):
        rig.create(f"r{k}", budget=16, policy_scope="submit")
        rig.submit(*range(8), run=f"r{k}")
    assert [len(rig.poll(session, 64)) for _ in range(3)] == [3, 3, 0]
