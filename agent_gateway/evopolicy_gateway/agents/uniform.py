"""`random`: the agent of the tables' random row. Submits a policy of uniform random actions once, with the largest
permitted number of episodes.

Run as `python -m evopolicy_gateway.agents.uniform` in the workspace, with the `EVOPOLICYGYM_*` URLs set.
"""

from __future__ import annotations

from pathlib import Path

from evopolicy_gateway.agents.client import Client, RefusedSubmit, exit_after

POLICY = '''"""Uniform random actions on any action space; elements without a bound are normal."""

import random

LETTERS = "abcdefghijklmnopqrstuvwxyz"


def sample(space):
    kind = space["type"]
    if kind == "Discrete":
        return space.get("start", 0) + random.randrange(space["n"])
    if kind == "MultiDiscrete":
        return _choices(space["nvec"], space.get("start", 0))
    if kind == "MultiBinary":
        n = space["n"]
        return _filled(n if isinstance(n, list) else [n], 0, 1, True)
    if kind == "Box":
        low, high = space.get("low", space.get("min")), space.get("high", space.get("max"))
        return _filled(space["shape"], low, high, not space["dtype"].startswith("float"))
    if kind == "Tuple":
        return tuple(sample(part) for part in space["spaces"])
    if kind == "Dict":
        return {key: sample(part) for key, part in space["spaces"].items()}
    if kind == "Text":
        length = random.randint(space["min_length"], space["max_length"])
        return "".join(random.choice(space.get("characters", LETTERS)) for _ in range(length))
    if kind == "Sequence":
        return [sample(space["space"]) for _ in range(random.randrange(8))]
    if kind == "OneOf":
        index = random.randrange(len(space["spaces"]))
        return (index, sample(space["spaces"][index]))
    if kind == "Graph":
        nodes = [sample(space["node_space"]) for _ in range(random.randint(1, 8))]
        n = random.randrange(8) if space["edge_space"] else 0
        if not n:
            return {"nodes": nodes, "edges": None, "edge_links": None}
        links = [[random.randrange(len(nodes)), random.randrange(len(nodes))] for _ in range(n)]
        return {"nodes": nodes, "edges": [sample(space["edge_space"]) for _ in range(n)], "edge_links": links}
    raise ValueError("no actions for a space of type " + kind)


def _choices(nvec, start):
    if not isinstance(nvec, list):
        return start + random.randrange(nvec)
    starts = start if isinstance(start, list) else [start] * len(nvec)
    return [_choices(n, first) for n, first in zip(nvec, starts)]


def _filled(shape, low, high, whole):
    if not shape:
        low, high = float(low), float(high)
        if whole:
            return random.randint(int(low), int(high))
        if low == float("-inf") or high == float("inf"):
            return min(max(random.gauss(0.0, 1.0), low), high)
        return random.uniform(low, high)
    return [
        _filled(
            shape[1:],
            low[i] if isinstance(low, list) else low,
            high[i] if isinstance(high, list) else high,
            whole,
        )
        for i in range(shape[0])
    ]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return sample(self.space)
'''


def submit_random(client: Client, workspace: Path) -> bool:
    """Submits once and returns whether it was accepted. Raises ProtocolError when the gateway stays unreachable."""
    info = client.info()
    n_cases = int(info["env_meta"]["n_env_instances"])
    n_episodes = min(int(info["state"]["remaining_budget"]), int(info["max_episodes_per_submit"]))
    (workspace / "system" / "policy.py").write_text(POLICY, encoding="utf-8")
    verdict = client.submit([index % n_cases for index in range(n_episodes)])
    if isinstance(verdict, RefusedSubmit):
        print(f"refused, {verdict.status}: {verdict.message}", flush=True)
        return False
    print(f"{verdict.name}: {verdict.status} {verdict.summary.get('mean_return')}", flush=True)
    return True


def main() -> None:
    """Runs the agent in the current directory."""
    exit_after("random", lambda client: submit_random(client, Path.cwd()))


if __name__ == "__main__":
    main()
