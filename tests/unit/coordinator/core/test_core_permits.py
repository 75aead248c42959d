"""An agent starts once no related hidden episode is played on its kernel, and none starts there while it may be
alive."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from rigs.core_rig import Rig, describe, fingerprint, result, split_of

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.run_settings import ELSEWHERE
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.agents import permits
from evopolicy_coordinator.core.contract.records import PermitRow
from evopolicy_coordinator.core.isolation import conflicts

HERE = "kernel-of-w1"


def scored(rig: Rig, **worker: Any) -> str:
    """A worker, and run r0 that is closed and has hidden cases to play. Returns the worker's session."""
    session = rig.register(slots=8, **worker)
    rig.create("r0")
    rig.submit(0, run="r0")
    rig.play(session, *rig.poll(session))
    rig.close("r0")
    return session


def played(rig: Rig) -> tuple[str, list[wire.Lease]]:
    """The same while its hidden cases are played, and run r1 whose agent has no permit yet."""
    session = scored(rig)
    leases = rig.poll(session, 8)
    rig.create("r1", agent=None)
    return session, leases


def gone(rig: Rig, run: str = "r1", boot_id: str = "") -> Any:
    return rig.ask(operator.AgentGone, run=run, boot_id=boot_id)


def splits(leases: list[wire.Lease]) -> set[str]:
    return {split_of(lease.job) for lease in leases}


def test_a_permit_is_durable_and_asked_for_again_at_no_cost(rig: Rig) -> None:
    rig.register()
    rig.create(agent=None)
    for _ in range(2):
        assert rig.permit("r1", HERE, host="lab") == gateway.Permit(granted=True)
    row = rig.row(PermitRow, "r1", HERE)
    assert (row.host, row.ended_at) == ("lab", None)
    rig.load()
    assert rig.status().runs[0].agent_host == "lab"


@pytest.mark.parametrize("restart", [False, True])
def test_nothing_hidden_is_leased_where_a_related_agent_may_be_alive(rig: Rig, restart: bool) -> None:
    """Attack: listens while its own checkpoints are validated on its machine. Defence: its permit bars its
    run's hidden cases from that kernel while it may be alive."""
    session = scored(rig)
    rig.create("r1", agent=HERE)
    if restart:
        session = rig.restarted()
    assert splits(rig.poll(session, 8)) == {"random"}
    assert "alive" in rig.status().workers[0].hidden_bar
    other = rig.register("w2", slots=8)
    assert splits(rig.poll(other, 8)) == {"validation"}


@pytest.mark.parametrize(
    ("rule", "agent", "wanted"),
    [
        ("related", {"agent": HERE, "hidden_from": 5000}, {"random", "validation"}),
        ("strict", {"agent": HERE, "hidden_from": 5000}, {"random"}),
        ("related", {"agent": HERE, "hidden_from": 1001}, {"random"}),  # one case is shared
        ("related", {"agent": ""}, {"random"}),  # it may be anywhere
        ("off", {"agent": ""}, {"random", "validation"}),
    ],
)
def test_agents_keep_the_hidden_cases_of_related_runs_from_their_kernels(
    rule: str, agent: dict[str, Any], wanted: set[str]
) -> None:
    """Attack: listens while a sibling run is scored there. Defence: runs that share one hidden case are
    related."""
    rig = Rig(hidden_isolation=rule)
    session = scored(rig)
    rig.create("r1", **agent)
    assert splits(rig.poll(session, 8)) == wanted
    assert rig.status().runs[-1].agent_host == (agent["agent"] or "everywhere")


def test_an_agent_gone_from_one_kernel_is_not_ended_elsewhere(rig: Rig) -> None:
    rig.register()
    rig.create("r1", agent="lost")
    rig.permit("r1", HERE)
    gone(rig, boot_id="lost")
    assert rig.row(PermitRow, "r1", "lost").ended_at is not None
    assert rig.row(PermitRow, "r1", HERE).ended_at is None
    gone(rig)
    assert rig.row(PermitRow, "r1", HERE).ended_at is not None


def test_a_worker_on_an_unknown_kernel_plays_nothing_hidden(rig: Rig) -> None:
    session = scored(rig, boot_id="")
    assert splits(rig.poll(session, 8)) == {"random"}
    registered = next(reply for reply in rig.replies.values() if isinstance(reply, wire.Registered))
    assert "boot id" in registered.hidden_bar
    assert registered.hidden_bar == rig.status().workers[0].hidden_bar


def test_a_permit_waits_until_hidden_jobs_have_ended(rig: Rig) -> None:
    """Attack: starts while a hidden episode is played. Defence: the permit is granted only after the worker has
    released the episode; none is leased there in the meantime."""
    session = scored(rig)
    leases = rig.poll(session, 1)
    while splits(leases) != {"validation"}:
        rig.play(session, *leases)
        leases = rig.poll(session, 1)
    rig.create("r1", agent=None)
    assert rig.permit("r1", HERE, wait_s=3.0) is None
    request = rig._requests
    assert rig.beat(session, *leases).cancelled == ()
    assert "validation" not in splits(rig.poll(session, 8))
    rig.pass_time(3.0)
    assert (rig.replies[request].granted, "hidden" in rig.replies[request].waits_for) == (False, True)
    assert rig.permit("r1", HERE, wait_s=20.0) is None
    request = rig._requests
    rig.play(session, *leases)
    assert rig.replies[request] == gateway.Permit(granted=True)
    assert rig.core.state.runs["r0"].state.infrastructure_retries == 0


def test_an_open_run_plays_nothing_hidden(rig: Rig) -> None:
    """Attack: has its checkpoints validated while it can still submit. Defence: hidden episodes start when the run has
    closed."""
    session = rig.begin(0, worker={"slots": 8}, run={"agent": "remote"})
    rig.play(session, *rig.poll(session))
    assert rig.poll(session, 8) == []
    session = rig.restarted()
    assert rig.poll(session, 8) == []
    rig.close()
    assert splits(rig.poll(session, 8)) == {"validation", "random"}


@pytest.mark.parametrize("restart", [False, True])
def test_each_submit_is_validated_once_equal_bundles_too(rig: Rig, restart: bool) -> None:
    session = rig.begin(0, worker={"slots": 8}, run={"agent": "remote", "n_valid": 2})
    rig.play(session, *rig.poll(session))
    rig.submit(1, key="k1")
    rig.play(session, *rig.poll(session))
    rig.close()
    jobs: Counter[str] = Counter()
    for _ in range(20):
        leases = rig.poll(session, 1)
        jobs.update(lease.job.job_id for lease in leases)
        rig.play(session, *leases)
        if restart:
            session = rig.restarted()
    validated = {job: n for job, n in jobs.items() if "/validation/" in job}
    assert validated == {f"r1/s{index}/validation/{case}": 1 for index in (0, 1) for case in (0, 1)}
    assert rig.finished().status == "completed"


def test_a_request_that_is_never_sent_again_is_forgotten(rig: Rig) -> None:
    session = scored(rig)
    leases: list[wire.Lease] = []
    while splits(leases) != {"validation"}:
        rig.play(session, *leases)
        leases = rig.poll(session, 1)
    rig.create("r1", agent=None)
    assert not rig.permit("r1", HERE).granted
    assert "validation" not in splits(rig.poll(session, 8))
    rig.stay(session, 3, 4.0, *leases)
    assert "validation" in splits(rig.poll(session, 8))
    assert conflicts.kernel(rig.core.state, HERE).asks == {}


def test_a_silent_workers_kernel_stays_barred_until_it_has_surely_stopped(rig: Rig) -> None:
    """Attack: starts while a hidden episode is being stopped, or while its worker is silent. Defence: the
    permit is granted only after the worker has released the episode, or has certainly stopped it."""
    played(rig)
    rig.pass_time(20.0)  # the worker is lost, its leases are given up
    assert rig.core.state.workers["w1"].state == "lost"
    assert not rig.permit("r1", HERE).granted
    assert rig.permit("r1", HERE, wait_s=60.0) is None
    request = rig._requests
    rig.pass_time(rig.settings.silent_bar_s - 20.5)
    assert request not in rig.replies
    rig.pass_time(1.0)
    assert rig.replies[request].granted


def test_a_returning_worker_without_leases_frees_its_kernel(rig: Rig) -> None:
    session, leases = played(rig)
    rig.pass_time(20.0)
    rig.beat(session, *leases)
    assert not rig.permit("r1", HERE).granted
    rig.beat(session)
    assert rig.permit("r1", HERE).granted


def test_a_lease_in_transit_is_not_taken_for_a_released_one(rig: Rig) -> None:
    session = scored(rig)
    rig.stay(session, 2, 10.0)  # no lease is given up just after a start
    rig.poll(session, 8, serial=7)
    rig.create("r1", agent=None)
    assert not rig.permit("r1", HERE).granted
    rig.pass_time(7.0)
    for settled in (6, 7):
        rig.ask(wire.Heartbeat, worker="w1", session=session, held=(), settled=settled)
        assert rig.permit("r1", HERE).granted is (settled == 7)


def test_known_workers_count_as_playing_after_a_restart_until_heard(rig: Rig) -> None:
    session, leases = played(rig)
    rig.load()
    assert not rig.permit("r1", HERE).granted
    assert rig.permit("r1", "another-machine").granted
    session = rig.register(slots=8, beats=False)
    rig.beat(session, *leases)
    assert not rig.permit("r1", HERE).granted  # it plays them to their end
    rig.play(session, *leases)
    assert rig.permit("r1", HERE).granted


def test_a_hidden_lease_is_not_adopted_where_an_agent_may_be_alive(rig: Rig) -> None:
    session = scored(rig)
    leases = rig.poll(session, 8)
    hidden = {lease.lease_id for lease in leases if split_of(lease.job) == "validation"}
    rig.load()
    rig.rows[PermitRow, "r0", HERE] = PermitRow(run="r0", boot_id=HERE)
    rig.load()
    session = rig.register(slots=8)
    assert set(rig.beat(session, *leases).cancelled) == hidden


def test_a_permit_ends_with_its_run(rig: Rig) -> None:
    session = rig.begin(0, worker={"slots": 8}, run={"agent": HERE})
    rig.play(session, *rig.poll(session))
    rig.close()
    assert rig.row(PermitRow, "r1", HERE).ended_at == rig.now
    assert splits(rig.poll(session, 8)) == {"validation", "random"}


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize("confirmed", [False, True])
def test_a_cancelled_runs_permit_ends_by_its_gateway_or_time(
    rig: Rig, restart: bool, confirmed: bool
) -> None:
    """Attack: stays alive after its gateway was lost or its run cancelled. Defence: the kernel stays
    barred until the run is closed or the operator vouches; half a minute after a cancellation."""
    session = scored(rig)
    rig.create("r1", agent=HERE)
    rig.ask(operator.CancelRun, run="r1")
    if restart:
        session = rig.restarted()
    assert "validation" not in splits(rig.poll(session, 2))
    if confirmed:
        rig.close("r1")
    else:
        rig.stay(session, 2, 10.0)
        assert "validation" not in splits(rig.poll(session, 2))
        rig.stay(session, 1, 10.0)
    assert "validation" in splits(rig.poll(session, 8))
    rig.load()
    assert permits.permits_of_run(rig.core.state, "r1") == []


def test_an_operators_word_ends_a_permit_and_silence_does_not(rig: Rig) -> None:
    """Attack: stays alive after its gateway was lost or its run cancelled. Defence: the kernel stays
    barred until the run is closed or the operator vouches; half a minute after a cancellation."""
    session = scored(rig)
    rig.create("r1", agent=HERE)
    rig.play(session, *rig.poll(session, 8))
    rig.stay(session, 100, 5.0)
    assert rig.poll(session, 8) == []
    (waits_for,) = [run.waits_for for run in rig.status().runs if run.run == "r0"]
    assert "evopolicy runs agent-gone r1" in waits_for
    assert any("agent-gone r1" in line for line in rig.status().stalls)
    assert gone(rig) == operator.Done()
    assert splits(rig.poll(session, 8)) == {"validation"}
    assert gone(rig, "nobody").status == Refusal.UNKNOWN_RUN


@pytest.mark.parametrize("by", ["its own gateway", "another gateway", "another worker", "its own worker"])
def test_no_report_of_another_boot_id_ends_a_permit(rig: Rig, by: str) -> None:
    """Attack: the gateway of another run, or a worker, reports a new boot id of the agent's machine, as if
    it had been restarted. Defence: no report of another party ends a permit, and none of its own
    gateway but `CloseRun`."""
    session = scored(rig)
    for run in ("r1", "r2"):
        rig.create(run, agent=None)
    rig.ask(gateway.RequestPermit, run="r1", boot_id=HERE, host="lab")
    if "gateway" in by:
        run = "r1" if by == "its own gateway" else "r2"
        assert rig.ask(gateway.RequestPermit, run=run, boot_id="fake", host="lab").granted
    else:
        name = "w1" if by == "its own worker" else "w2"
        described = {"tiers": ("bwrap",), "environments": (describe(),), "fingerprint": fingerprint()}
        rig.ask(wire.Register, worker=name, session=f"{name}-x", slots=8, boot_id="fake", **described)
        session = rig.register("w3", slots=8, boot_id=HERE)
    assert rig.row(PermitRow, "r1", HERE).ended_at is None
    assert "validation" not in splits(rig.poll(session, 8))


def test_a_permit_on_a_kernel_that_no_worker_names_bars_nothing(rig: Rig) -> None:
    session = scored(rig)
    rig.create("r1", agent=HERE)
    assert splits(rig.poll(session, 8)) == {"random"}
    session = rig.register(slots=8, boot_id="another")  # the machine was restarted
    assert splits(rig.poll(session, 8)) == {"validation"}


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize("there", [HERE, "another"])
def test_a_stranger_under_a_lost_workers_name_frees_no_kernel(rig: Rig, there: str, restart: bool) -> None:
    """Attack: a worker takes the name of a lost one that may still play, and states that it holds nothing.
    Defence: a heartbeat releases only what is on its own kernel and was leased to its own machine."""
    session = scored(rig, machine="m1")
    leases = rig.poll(session, 8)
    assert "validation" in splits(leases)
    if restart:
        rig.load()
    else:
        rig.pass_time(20.0)
    stranger = rig.register(slots=8, machine="m2", boot_id=there)
    rig.beat(stranger)
    rig.create("r1", agent=None)
    assert not rig.permit("r1", HERE).granted
    rig.pass_time(rig.settings.silent_bar_s)
    assert rig.permit("r1", HERE).granted


def test_a_worker_on_another_kernel_speaks_for_no_earlier_one(rig: Rig) -> None:
    """Attack: a worker takes the name of a lost one that may still play, and states that it holds nothing.
    Defence: a heartbeat releases only what is on its own kernel and was leased to its own machine."""
    session = scored(rig)
    assert "validation" in splits(rig.poll(session, 8))
    session = rig.begin(worker={"slots": 8, "boot_id": "another"}, run={"agent": None})
    rig.stay(session, 10, 2.0)
    assert not rig.permit("r1", HERE).granted
    assert rig.permit("r1", "elsewhere").granted
    rig.pass_time(rig.settings.silent_bar_s)
    assert rig.permit("r1", HERE).granted


def test_a_takeover_by_another_host_keeps_the_first_permit(rig: Rig) -> None:
    rig.register()
    rig.create("r1", agent=None)
    rig.permit("r1", HERE, host="first")
    rig.permit("r1", "elsewhere", host="second")
    assert rig.status().runs[0].agent_host == "first, second"
    gone(rig)
    assert rig.status().runs[0].agent_host == ""


@pytest.mark.parametrize("by", ["open", "submit"])
def test_an_agent_whose_gateway_asks_for_no_permit_may_be_anywhere(rig: Rig, by: str) -> None:
    """Attack: its gateway requests no permit, or does not state its machine. Defence: it counts as present
    on every machine."""
    session = scored(rig)
    hidden = rig.poll(session, 8)
    rig.create("r1", agent=None)

    def speak() -> Any:
        if by == "submit":
            return rig.submit(0, run="r1")
        return rig.ask(gateway.OpenRun, run="r1")

    assert speak().status == Refusal.UNAVAILABLE
    rig.report_results(session, *(result(lease, "returned") for lease in hidden))
    assert not hasattr(speak(), "status")
    assert rig.status().runs[1].agent_host == "everywhere"


def test_a_gateway_that_asks_for_permits_opens_its_run_without_one(rig: Rig) -> None:
    rig.register()
    rig.create("r1", agent=None)
    opened = rig.ask(gateway.OpenRun, run="r1", asks_permit=True)
    assert isinstance(opened, gateway.RunOpened)
    assert permits.permits_of_run(rig.core.state, "r1") == []


def test_a_remote_agents_stated_place_replaces_its_gateways_host(rig: Rig) -> None:
    rig.register()
    rig.create("r1", agent="gateway", agent_host="remote")
    assert [row.boot_id for _, row in permits.permits_of_run(rig.core.state, "r1")] == ["remote"]


def test_a_vouched_agent_needs_no_permit_and_is_stamped(rig: Rig) -> None:
    session = rig.begin(worker={"slots": 8}, run={"agent": "", "agent_host": ELSEWHERE})
    assert permits.permits_of_run(rig.core.state, "r1") == []
    rig.submit(0)
    rig.work_off(session)
    assert rig.finish(session).hidden_isolation == "waived"


@pytest.mark.parametrize(
    ("rules", "stamp"),
    [("rr", "exclusive"), ("oo", "shared"), ("ro", "shared"), ("or", "shared"), ("ror", "shared")],
)
def test_a_run_is_stamped_with_what_held_all_its_life(rules: str, stamp: str) -> None:
    names = {"r": "related", "o": "off"}
    rig = Rig(hidden_isolation=names[rules[0]])
    rig.create()
    for rule in rules[1:]:
        rig.settings = type(rig.settings)(hidden_isolation=names[rule])  # type: ignore[arg-type]
        rig.load()
    session = rig.register()
    rig.submit(0)
    rig.work_off(session)
    assert rig.finish(session).hidden_isolation == stamp


def test_closed_runs_and_cancelled_ones_get_no_permit(rig: Rig) -> None:
    session = scored(rig)
    assert rig.permit("r0").status == Refusal.RUN_CLOSED
    leases = rig.poll(session, 8)
    rig.create("r1", agent=None)
    assert rig.permit("r1", HERE, wait_s=9.0) is None
    request = rig._requests
    rig.ask(operator.CancelRun, run="r1")
    assert rig.replies[request].status == Refusal.RUN_CANCELLED
    rig.report_results(session, *(result(lease, "returned") for lease in leases))
    assert splits(rig.poll(session, 8)) == {"random", "validation"}


def test_case_sets_are_forgotten_with_their_last_user(rig: Rig) -> None:
    session = rig.register()
    for name in ("r1", "r2"):
        rig.create(name, agent=HERE)
        rig.submit(0, run=name)
    rig.work_off(session)
    for name in ("r1", "r2"):
        rig.close(name)
    rig.work_off(session)
    case_sets = rig.core.state.case_sets
    assert (case_sets._known, case_sets._of_case) == ({}, {})


def test_a_gateway_may_name_only_so_many_kernels(rig: Rig) -> None:
    """Attack: requests permits for ever more kernels, to keep hidden episodes from them and to fill the
    database. Defence: 16 kernels for a run."""
    rig.register()
    rig.create(agent=None)
    answers = [rig.permit("r1", f"kernel-{n}") for n in range(20)]
    granted = [isinstance(each, gateway.Permit) for each in answers]
    assert granted == [True] * 16 + [False] * 4
    assert answers[-1].status == "bad_request"
    assert "agent-gone" in answers[-1].message
    rig.load()
    assert rig.permit("r1", "kernel-16").status == "bad_request"
    # Where it was it may be, and the operator can let it go on.
    assert rig.permit("r1", "kernel-3").granted
    gone(rig)
    assert rig.permit("r1", "kernel-16").granted
