"""Agents and hidden cases take turns on a kernel, and neither waits for ever."""

from __future__ import annotations

from typing import Any

import pytest
from rigs.core_rig import Rig, split_of

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_coordinator.core.contract.records import OutcomeRow
from evopolicy_coordinator.core.isolation import conflicts

HERE = "kernel-of-w1"
WAIT_S = 60.0


def closed(rig: Rig, session: str, run: str) -> None:
    """A run with hidden cases to play, whose agent is gone."""
    rig.create(run)
    rig.submit(0, run=run)
    rig.play(session, *rig.poll(session))
    rig.close(run)


def splits(leases: list[wire.Lease]) -> list[str]:
    return sorted({split_of(lease.job) for lease in leases})


def reserved(rig: Rig) -> list[str]:
    return [name for name, kernel in rig.core.state.kernels.items() if kernel.reservations]


def keep_alive(rig: Rig, session: str, seconds: float, *held: wire.Lease) -> None:
    for _ in range(int(seconds / 2.0)):
        rig.pass_time(2.0)
        rig.poll(session, 0)
        rig.beat(session, *held)


def beside(rig: Rig, slots: int = 8, agent: str = HERE) -> str:
    """A worker, a closed run `r0` with hidden cases to play, and a run `r1` whose agent is there."""
    session = rig.register(slots=slots)
    closed(rig, session, "r0")
    rig.create("r1", agent=agent)
    rig.play(session, *rig.poll(session, slots))  # the random reference
    return session


def until_hidden(rig: Rig, session: str) -> wire.Lease:
    """A job of hidden cases, for which a further train job of r1's submit waits."""
    rig.submit(0, 1, run="r1")
    (train,) = rig.poll(session, 1)
    while split_of(train.job) != "train":
        rig.play(session, train)
        (train,) = rig.poll(session, 1)
    # A train job that runs keeps the hidden ones away; meanwhile the order is turned over.
    rig.core.state.runs["r0"].flow.kept_s = WAIT_S
    keep_alive(rig, session, 4.0, train)
    rig.play(session, train)
    (hidden,) = rig.poll(session, 1)
    assert split_of(hidden.job) == "validation"
    return hidden


def waiting(rig: Rig, slots: int = 8) -> str:
    """The same after the hidden cases of `r0` have waited for long for the agent of `r1`."""
    session = beside(rig, slots)
    keep_alive(rig, session, WAIT_S + 4.0)
    return session


def test_long_waiting_hidden_cases_keep_new_agents_away(rig: Rig) -> None:
    session = waiting(rig)
    rig.create("r2", agent=None)
    assert not rig.permit("r2", HERE).granted
    assert rig.permit("r2", "another").granted
    # The agent that is there goes on to its end.
    rig.submit(0, run="r1")
    (train,) = rig.poll(session, 8)
    assert split_of(train.job) == "train"
    rig.play(session, train)
    rig.close("r1")
    hidden = rig.poll(session, 32)
    assert splits(hidden) == ["random", "validation"]


def test_the_order_is_turned_back_when_nothing_hidden_is_left(rig: Rig) -> None:
    session = waiting(rig)
    rig.create("r2", agent=None)
    assert rig.permit("r2", HERE, wait_s=30.0) is None
    request = rig._requests
    rig.close("r1")
    rig.work_off(session)
    assert rig.finished("r0").status == "completed"
    keep_alive(rig, session, 6.0)
    assert rig.replies[request].granted


def test_with_agents_elsewhere_train_and_hidden_jobs_take_turns() -> None:
    rig = Rig(hidden_wait_s=20.0)
    session = rig.begin(worker={"slots": 1}, run={"agent": "remote", "budget": 64, "train": 64, "most": 64})
    closed(rig, session, "r0")
    rig.submit(*range(60), run="r1")
    trace: list[str] = []
    for _ in range(200):
        leases = rig.poll(session, 1)
        keep_alive(rig, session, 4.0, *leases)
        rig.play(session, *leases)
        trace += [split_of(lease.job) for lease in leases]
        if "r0" not in rig.core.state.runs:
            break
    hidden = [place for place, split in enumerate(trace) if split in ("validation", "heldout")]
    assert len(hidden) == 5
    assert 20.0 <= 4.0 * hidden[0] <= 20.0 + 4 * 4.0  # after their wait, and what ran then
    assert hidden == list(range(hidden[0], hidden[0] + 5))  # and then to their end
    assert trace[-1] == "random" or rig.finished("r0").status == "completed"


def test_submits_that_wait_for_hidden_cases_say_so(rig: Rig) -> None:
    session = beside(rig, slots=1, agent="remote")
    hidden = until_hidden(rig, session)
    keep_alive(rig, session, 10.0, hidden)
    state = rig.ask(gateway.StateRequest, run="r1")
    assert state.waits_for == "hidden cases of another run to be scored"
    assert 7.0 <= state.open_held_s <= 11.0
    assert state.held_s == state.open_held_s
    page = rig.results(run="r1", cursor=1)
    assert page.held_s == state.held_s
    while (leases := rig.poll(session, 1)) or rig.core.state.workers["w1"].leases:
        rig.play(session, *(leases or [hidden]))
        keep_alive(rig, session, 2.0)
    assert rig.core.state.runs["r1"].submits[0].status == "ok"
    held_s = rig.core.state.runs["r1"].submits[0].held_s
    assert held_s >= 7.0
    rig.load()
    rig.register(slots=1)
    assert rig.ask(gateway.StateRequest, run="r1").held_s == held_s


def test_the_time_a_submit_is_held_counts_against_no_limit(rig: Rig) -> None:
    session = rig.register(slots=1)
    rig.create("r1", agent="remote", limits=ResourceLimits(submit_wall_s=20.0))
    closed(rig, session, "r0")
    rig.play(session, *rig.poll(session, 1))
    hidden = until_hidden(rig, session)
    keep_alive(rig, session, 30.0, hidden)  # longer than the limit
    assert rig.core.state.runs["r1"].submits[0].status is None
    rig.play(session, hidden)
    for _ in range(20):
        leases = rig.poll(session, 1)
        if leases and split_of(leases[0].job) == "train":
            break
        rig.play(session, *leases)
        keep_alive(rig, session, 2.0)
    keep_alive(rig, session, 20.0, *leases)
    assert rig.core.state.runs["r1"].submits[0].status == "rollout_timeout"


@pytest.mark.parametrize("where", ["", HERE])
@pytest.mark.parametrize("restart", [False, True])
def test_a_run_that_keeps_others_waiting_for_too_long_is_cancelled(where: str, restart: bool) -> None:
    """Attack: its gateway claims all kernels, or an unknown one, and never closes the run, so that related
    runs get no scores. Defence: the status names the run and the operator's commands; the run is
    cancelled seven days after the start (`--agent-wait`)."""
    rig = Rig(agent_wait_s=600.0)
    session = rig.begin(worker={"slots": 8}, run={"agent": where})
    rig.create("r2", agent="remote")
    rig.create("r3", agent=HERE, hidden_from=9000)  # shares no hidden case
    keep_alive(rig, session, 700.0)
    assert "r1" in rig.core.state.runs, "it keeps nobody waiting"
    closed(rig, session, "r0")
    if restart:
        rig.load()
        session = rig.register(slots=8)
    rig.play(session, *rig.poll(session, 8))
    keep_alive(rig, session, WAIT_S - 8.0)
    assert "r1" in rig.core.state.runs
    keep_alive(rig, session, 12.0)
    assert rig.finished("r1").status == "cancelled"
    assert {"r2", "r3"} <= rig.core.state.runs.keys()
    assert rig.permit("r1", where).status == "run_cancelled"
    assert "validation" not in splits(rig.poll(session, 8))  # its agent has its time to end
    keep_alive(rig, session, 30.0)
    assert "validation" in splits(rig.poll(session, 8))


def test_an_agent_that_delays_others_is_named_until_its_limit() -> None:
    """Attack: its gateway claims all kernels, or an unknown one, and never closes the run, so that related
    runs get no scores. Defence: the status names the run and the operator's commands; the run is
    cancelled seven days after the start (`--agent-wait`)."""
    rig = Rig(agent_wait_s=600.0)
    session = beside(rig, agent="")
    keep_alive(rig, session, 590.0)
    (stall,) = rig.status().stalls
    assert "agent of r1" in stall
    assert "runs agent-gone r1" in stall
    assert "runs cancel r1" in stall
    keep_alive(rig, session, 20.0)
    assert "r1" not in rig.core.state.runs


@pytest.mark.parametrize("why", ["draining", "lost"])
def test_a_kernel_whose_workers_are_gone_is_turned_back(rig: Rig, why: str) -> None:
    session = waiting(rig)
    assert conflicts.kernel(rig.core.state, HERE).reservations
    if why == "draining":
        rig.ask(operator.SetWorker, worker="w1", state="draining")
        keep_alive(rig, session, 4.0)
    else:
        rig.pass_time(20.0)
    rig.create("r2", agent=None)
    assert rig.permit("r2", HERE).granted


def test_the_kernel_with_the_fewest_related_agents_is_reserved(rig: Rig) -> None:
    sessions = [rig.register(name, slots=8) for name in ("w1", "w2")]
    closed(rig, sessions[0], "r0")
    for number, where in enumerate((HERE, HERE, "kernel-of-w2"), 1):
        rig.create(f"r{number}", agent=where)
    for session in sessions:
        rig.play(session, *rig.poll(session, 8))
    for _ in range(40):
        rig.pass_time(2.0)
        for session in sessions:
            rig.poll(session, 0)
            rig.beat(session)
    assert reserved(rig) == ["kernel-of-w2"]


def test_a_closed_runs_hidden_cases_precede_others_train_jobs(rig: Rig) -> None:
    session = waiting(rig, slots=1)
    rig.create("r2", agent="remote", hidden_from=9000)
    rig.submit(0, 1, run="r2")
    rig.close("r1")
    assert splits(rig.poll(session, 1)) == ["validation"]


def test_one_host_one_slot_and_four_runs_come_to_an_end() -> None:
    rig = Rig(hidden_wait_s=10.0)
    session = rig.register(slots=1)
    runs = [f"r{number}" for number in range(8)]
    pending, alive, left = list(runs), [], {}
    for _ in range(3000):
        for run in list(pending):
            if len(alive) == 4:
                break
            if run not in rig.core.state.runs:
                rig.create(run, agent=None)
            if not rig.permit(run, HERE).granted:
                break
            pending.remove(run)
            alive.append(run)
            left[run] = 3
        for run in list(alive):
            if rig.core.state.runs[run].open is not None:
                continue
            if left[run]:
                left[run] -= 1
                rig.submit(0, 1, run=run, key=f"k{left[run]}")
            else:
                rig.close(run)
                alive.remove(run)
        leases = rig.poll(session, 1)
        rig.pass_time(1.0)
        rig.beat(session, *leases)
        rig.play(session, *leases)
        stopped = [lease for lease in rig.core.state.workers["w1"].leases.values() if not lease.live]
        assert not stopped, "one at a time: nothing is stopped that is not handed in"
        if not rig.core.state.runs and not pending:
            break
    assert [rig.finished(run).status for run in runs] == ["completed"] * 8
    assert {rig.finished(run).hidden_isolation for run in runs} == {"exclusive"}


def test_related_train_and_hidden_jobs_never_share_a_kernel(rig: Rig) -> None:
    """Attack: has a hidden episode signal a train episode beside it, whose feedback reaches an agent
    anywhere. Defence: train and hidden jobs of related runs are never leased on one kernel."""
    first, second = rig.register("w1", slots=4, boot_id="one"), rig.register("w2", slots=4, boot_id="one")
    rig.create("r0", n_valid=6)
    rig.submit(0, run="r0")
    rig.play(first, *rig.poll(first))
    rig.close("r0")
    hidden: list[wire.Lease] = []
    while len(hidden) < 4:
        leases = rig.poll(first, 1)
        rig.play(first, *[lease for lease in leases if split_of(lease.job) == "random"])
        hidden += [lease for lease in leases if split_of(lease.job) != "random"]
    rig.create("r1", agent="remote")
    rig.submit(0, 1, run="r1")
    assert "train" not in splits(rig.poll(second, 4))
    rig.play(first, hidden[0])
    assert splits(rig.poll(first, 4)) == [], "hidden jobs wait for related train jobs that wait"
    rig.play(first, *hidden[1:])
    train = rig.poll(second, 4)
    assert splits(train) == ["train"]
    assert splits(rig.poll(first, 4)) == []
    rig.play(second, *train)
    assert "validation" in splits(rig.poll(first, 4))


def test_a_rescore_waits_for_agents_of_related_runs(rig: Rig) -> None:
    """Attack: listens while finished runs, with which it shares hidden cases, are re-scored on further
    cases. Defence: a re-score counts as sharing its run's hidden cases."""
    session = rig.begin(worker={"slots": 8}, run={"agent": HERE})
    hidden = rig.core.state.runs["r1"].row.heldout

    new: dict[str, Any] = {"split": "heldout", "case_ids": (40,), "cases": (Case(seed=77_000),)}
    rig.evaluate("of-another-epoch", record="actions", related=(), **new)
    rig.evaluate("of-this-epoch", record="actions", related=hidden, **new)
    rig.play(session, *[lease for lease in rig.poll(session, 8) if split_of(lease.job) != "random"])
    played = {row.group for row in rig.rows.values() if isinstance(row, OutcomeRow)}
    assert played == {"evaluation/of-another-epoch"}
    for restarted in (False, True):
        if restarted:
            rig.load()
            session = rig.register(slots=8)
            rig.pass_time(5.0)
        assert not any("of-this-epoch" in lease.job.job_id for lease in rig.poll(session, 8))
    rig.close("r1")
    rig.work_off(session)
    played = {row.group for row in rig.rows.values() if isinstance(row, OutcomeRow)}
    assert "evaluation/of-this-epoch" in played


def test_a_worker_that_never_polls_neither_frees_hidden_cases_nor_bars_agents(rig: Rig) -> None:
    """Attack: registers on a made-up kernel, so that hidden cases seem to have a place without agents."""
    session = beside(rig)
    idle = rig.register("w2", boot_id="made-up")
    for _ in range(40):
        rig.pass_time(2.0)
        rig.poll(session, 8)
        rig.beat(session)
        rig.beat(idle)
    assert reserved(rig) == [HERE]
    for _ in range(20):  # now the other one polls no more
        rig.pass_time(2.0)
        rig.beat(session)
        rig.beat(idle)
    assert reserved(rig) == []
    rig.create("r2", agent=None)
    assert rig.permit("r2", HERE).granted


@pytest.mark.parametrize("away", ["class", "tier"])
def test_hidden_cases_that_nobody_there_can_play_keep_no_agent_away(rig: Rig, away: str) -> None:
    session = beside(rig)
    rig.ask(operator.SetWorker, worker="w1", state="paused")
    more = {"version": "2"} if away == "class" else {"tiers": ("landlock",)}
    other = rig.register("w2", boot_id=HERE, **more)
    for _ in range(80):
        rig.pass_time(2.0)
        rig.poll(other)
        rig.beat(session)
        rig.beat(other)
    assert reserved(rig) == []
    rig.create("r2", agent=None)
    assert rig.permit("r2", HERE).granted


def test_endless_scoring_leaves_a_waiting_submit_its_turn(rig: Rig) -> None:
    """Attack: closes one related run after another, so that hidden cases hold the submits of others for ever. Defence:
    hidden cases that come later do not prolong a reservation."""
    session = rig.register(slots=1)
    rig.create("r1", agent="remote")
    closed(rig, session, "c0")
    rig.submit(0, 1, run="r1")
    n = 0
    for _ in range(400):
        if sum(name.startswith("c") for name in rig.core.state.runs) < 3:
            n += 1
            rig.create(f"c{n}", agent="remote", train=4)
            rig.submit(0, run=f"c{n}")
        for lease in rig.poll(session, 1):
            keep_alive(rig, session, 6.0, lease)
            rig.play(session, lease)
        for name, run in list(rig.core.state.runs.items()):
            if name.startswith("c") and run.state.phase == "open" and run.open is None:
                rig.close(name)
        keep_alive(rig, session, 2.0)
        if rig.core.state.runs["r1"].open is None:
            break
    assert rig.core.state.runs["r1"].submits[0].status == "ok"


def test_hidden_cases_and_a_submit_that_wait_at_a_restart_both_end() -> None:
    rig = Rig(hidden_wait_s=20.0)
    session = rig.begin(worker={"slots": 1}, run={"agent": "remote", "budget": 64, "train": 64, "most": 64})
    closed(rig, session, "r0")
    rig.submit(*range(20), run="r1")
    assert splits(rig.poll(session, 1)) == ["train"]
    for _ in range(6):
        rig.load()
        session = rig.register(slots=1)
        keep_alive(rig, session, 8.0)
    for _ in range(200):
        leases = rig.poll(session, 1)
        keep_alive(rig, session, 2.0, *leases)
        rig.play(session, *leases)
    assert rig.finished("r0").status == "completed"
    assert rig.core.state.runs["r1"].submits[0].status == "ok"
