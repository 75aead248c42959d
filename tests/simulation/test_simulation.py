"""The simulation: seeds of the production core under faults, and bugs planted in the core.

`make test` plays 200 seeds, `make test-system` 800 more.
"""

from __future__ import annotations

import pytest
from sim_bugs import BUGS, Bug, planted
from sim_faults import RATES, Faults
from sim_scenario import Simulation
from simulate import play, replay_command

pytestmark = pytest.mark.slow

SEEDS, OFTEN = 1000, 200
"""All, and those of `make test`."""
SEEDS_PER_BUG = 500
NOTICED_BY = {
    "count late limit verdicts": 332,
    "show episodes before the gate": 15,
    "let ties go to the earlier submit": 68,
    "forget idempotency keys at a restart": 49,
    "take submits of a closed run": 47,
    "lease to a poll that was given up unread": 150,
    "leave runs unpinned when a worker is taken back": 15,
    "take a liveliness hint for the truth": 14,
    "expire leases after the loop stood still": 150,
    "adopt a job that is leased elsewhere": 60,
    "forget to tell a worker to stop": 13,
    "leave a lost worker's leases with it": 26,
    "forget at a restart what is to be audited": 16,
    "forget at a restart who is quarantined": 68,
    "let an agent start before hidden episodes have stopped": 19,
    "forget permits at a restart": 13,
    "forget what a silent worker may still play": 19,
    "take a lease on its way for one that was let go of": 200,
    "take all kernels for free after a restart": 107,
    "throw the dice of a stopped episode again at once": 68,
    "play train episodes beside hidden ones": 12,
    "forget the hidden jobs that train jobs wait behind": 51,
    "never preempt": 8,
    "end others' permits when a gateway names another kernel of their machine": 9,
    "end permits when a worker names another kernel of their machine": 19,
    "let a worker free the kernel of another of its name": 19,
    "let an agent keep others waiting for ever": 25,
    "believe in kernels on which nobody works": 25,
    "cancel a run that keeps others waiting at once": 9,
}
"""Seeds to try first for bugs that few seeds detect. After a change of the core other seeds may: then all are tried."""


@pytest.mark.parametrize(
    "first",
    [pytest.param(each, marks=[pytest.mark.system] * (each >= OFTEN)) for each in range(0, SEEDS, 100)],
)
def test_every_seed_ends_as_it_does_without_faults(first: int) -> None:
    for seed in range(first, first + 100):
        try:
            play(seed)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}\nreplay: {replay_command(seed)}") from error


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.title)
def test_a_planted_bug_is_caught(bug: Bug) -> None:
    with planted(bug):
        for seed in (NOTICED_BY.get(bug.title, 0), *range(SEEDS_PER_BUG)):
            try:
                play(seed)
            except AssertionError:
                return
    raise AssertionError(f"no seed of {SEEDS_PER_BUG} notices: {bug.title}")


def test_the_same_seed_gives_the_same_trace() -> None:
    def trace(seed: int) -> list[str]:
        simulation = Simulation(seed, trace=True)
        simulation.run()
        assert simulation.world.trace is not None
        return [line for line in simulation.world.trace if " object at " not in line]

    assert trace(5) == trace(5)


def test_a_slandering_auditor_is_named_by_some_seeds() -> None:
    assert any(play(seed).checkers.named for seed in range(4, 200, 8))


def test_every_fault_is_drawn_by_some_seed() -> None:
    drawn = [Simulation(seed).faults for seed in range(100)]
    for name in RATES:
        assert any(getattr(faults, name) > getattr(Faults(), name) for faults in drawn), name
