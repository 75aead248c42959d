"""Plays the hand-written policies of `examples/policies/` in this process and prints how well each does.

Made for developers with the extras `worker` and `coordinator`: one episode after another, no sandbox, no budget. A
fresh Policy plays each episode, as under the policy scope `episode`; actions are repaired as a worker repairs them, and
any that needed it are counted. The last columns put the mean beside the paper's Table 1: 0 is its random policy, 1 the
best of its agents (not clipped, so a value above 1 beats them all).

    python examples/measure_policies.py                          # everything, 32 seeds each: some ten minutes
    python examples/measure_policies.py gym/acrobot --seeds 8    # one environment
    python examples/measure_policies.py 'gymnasium/MiniGrid-*' --returns
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import importlib.util
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evopolicy_common.catalogue import entry, policy_folder, suites
from evopolicy_common.messages.environment import Case
from evopolicy_results.scoring.scores import heldout_returns
from evopolicy_worker.environments.interface.base import Environment
from evopolicy_worker.environments.registry import make

POLICIES = Path(__file__).resolve().parent / "policies"


@contextlib.contextmanager
def policy_class(folder: Path) -> Iterator[Any]:
    """The class `Policy` of `folder/policy.py`; modules that it imports from its folder are forgotten afterwards."""
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        spec = importlib.util.spec_from_file_location("policy", folder / "policy.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module.Policy
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(folder)):
                del sys.modules[name]


def play(environment: Environment, policy: Any, seed: int, max_steps: int) -> tuple[float, int, int, float]:
    """One episode: its return, its steps, how many actions were invalid, and the seconds spent in the policy."""
    obs = environment.reset(Case(seed=seed))
    policy.reset(0)
    total, steps, invalid, thinking = 0.0, 0, 0, 0.0
    while True:
        started = time.perf_counter()
        raw = policy.act(obs)
        thinking += time.perf_counter() - started
        action, repaired = environment.action_codec.repair(raw)
        obs, reward, terminated, truncated, _ = environment.step(action)
        total, steps, invalid = total + reward, steps + 1, invalid + repaired
        if terminated or truncated or steps == max_steps:
            return total, steps, invalid, thinking


def play_all(
    environment: Environment, folder: Path, seeds: Sequence[int], max_steps: int
) -> list[tuple[float, int, int, float]]:
    """Plays an episode a seed, each with a fresh instance of the folder's policy; see `play`."""
    about = environment.description
    meta = {"env": about.env, "submit_index": 0, "n_episodes_this_submit": len(seeds)}
    meta |= {"remaining_budget_after": 0, "max_episode_steps": about.max_episode_steps}
    meta |= {
        "obs_space": about.obs_space,
        "action_space": about.action_space,
        "obs_storage": about.obs_storage,
    }
    with policy_class(folder) as new:
        return [
            play(environment, new(about.obs_space, about.action_space, meta), seed, max_steps)
            for seed in seeds
        ]


def measure(env_id: str, seeds: range, *, show_returns: bool) -> str:
    """Play one environment's policy over `seeds`; its row of the table."""
    environment = make(env_id)
    max_steps = entry(env_id).published_steps or environment.description.max_episode_steps
    episodes = play_all(environment, policy_folder(POLICIES, env_id), seeds, max_steps)
    environment.close()
    returns, steps, invalid, thinking = (np.array(column) for column in zip(*episodes, strict=True))
    if show_returns:
        print(f"{env_id}: {np.round(returns, 3).tolist()}", file=sys.stderr)
    if invalid.any():
        print(f"{env_id}: {invalid.sum()} invalid actions", file=sys.stderr)
    column = heldout_returns().column(env_id)
    random = column.pop("Random policy")
    best = max(value for value in column.values() if value is not None)
    assert random is not None
    normalised = (returns.mean() - random) / (best - random)
    return (
        f"| {env_id} | {returns.mean():.3f} | {returns.std():.3f} | {steps.mean():.0f} | {random:.3f} | {best:.3f} "
        f"| {normalised:.2f} | {1e6 * thinking.sum() / steps.sum():.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("environments", nargs="*", default=["*"], help="suite ids or patterns; default: all")
    parser.add_argument("--seeds", type=int, default=32, help="episodes per environment (default 32)")
    parser.add_argument(
        "--first-seed", type=int, default=0, help="seeds are counted up from here (default 0)"
    )
    parser.add_argument("--returns", action="store_true", help="also print each episode's return, to stderr")
    arguments = parser.parse_args()
    chosen = [
        env_id
        for env_id in suites()["core16"].environments
        if any(fnmatch.fnmatchcase(env_id, pattern) for pattern in arguments.environments)
        and (policy_folder(POLICIES, env_id) / "policy.py").exists()
    ]
    if not chosen:
        parser.error(f"no policy for {' '.join(arguments.environments)} in {POLICIES}")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    print("| environment | mean return | std | steps | random | paper's best | normalised | µs per act |")
    print("|---|---|---|---|---|---|---|---|")
    for env_id in chosen:
        print(measure(env_id, seeds, show_returns=arguments.returns), flush=True)


if __name__ == "__main__":
    main()
