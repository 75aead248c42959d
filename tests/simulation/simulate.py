"""`make sim`: many seeds of the simulation, or one again: `make sim ARGS="--seed 17 --trace"`."""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1] / "support"))

from sim_scenario import Simulation, Size

SMALL = Size()
NIGHTLY = Size(runs=4, submits=6, episodes=12, hidden=6, workers=6)


def play(seed: int, size: Size = SMALL, *, trace: bool = False) -> Simulation:
    """Play one seed. Raises its errors."""
    simulation = Simulation(seed, size, trace=trace)
    try:
        simulation.run()
    except BaseException:
        if simulation.world.trace is not None:
            print("\n".join(simulation.world.trace))
        raise
    return simulation


def replay_command(seed: int, *, nightly: bool = False) -> str:
    """The command that replays a seed."""
    return f'make sim ARGS="--seed {seed} --trace{" --nightly" if nightly else ""}"'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000, help="how many seeds (1000)")
    parser.add_argument("--start", type=int, default=0, help="the first of them (0)")
    parser.add_argument("--seed", type=int, help="play this one only")
    parser.add_argument("--nightly", action="store_true", help="larger scenarios")
    parser.add_argument("--trace", action="store_true", help="print all that happens in a seed that fails")
    options = parser.parse_args()
    size = NIGHTLY if options.nightly else SMALL
    seeds = (
        [options.seed] if options.seed is not None else range(options.start, options.start + options.seeds)
    )
    began, steps, crashes, retries, longest = time.perf_counter(), 0, 0, 0, 0.0
    failed: list[int] = []
    for seed in seeds:
        try:
            simulation = play(seed, size, trace=options.trace)
        except Exception as error:
            failed.append(seed)
            faults = Simulation(seed, size).faults.named()
            print(f"seed {seed} fails: {type(error).__name__}: {error}\n  faults: {faults}")
            print(f"  replay: {replay_command(seed, nightly=options.nightly)}")
            if options.seed is not None or not isinstance(error, AssertionError):
                traceback.print_exc()
            continue
        steps += simulation.world.calls
        crashes += simulation.disk.incarnation - 1
        retries += simulation.checkers.retries
        longest = max(longest, simulation.world.now - 1000.0)
    took = time.perf_counter() - began
    print(
        f"{len(seeds)} seeds, {len(failed)} failed; {steps} simulated events, {crashes} restarts of the coordinator, "
        f"{retries} retried jobs, longest {longest:.0f} simulated s; {took:.1f} s"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
