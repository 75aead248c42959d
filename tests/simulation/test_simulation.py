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


@pytest.mark.timeout(900)
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


@pytest.mark.parametrize("bug", [pytest.param(bug, id=bug.title) for bug in BUGS])
def test_a_planted_bug_is_caught(bug: Bug) -> None:
    with planted(bug):
        for seed in (bug.seed, *range(SEEDS_PER_BUG)):
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


def test_every_fault_is_drawn_by_some_seed() -> None:
    drawn = [Simulation(seed).faults for seed in range(100)]
    for name in RATES:
        assert any(getattr(faults, name) > getattr(Faults(), name) for faults in drawn), name
