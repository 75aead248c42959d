"""Stages the workspace once, before the agent starts: `AGENTS.md`, `system/policy.py`, `feedback/`."""

from __future__ import annotations

import pprint
from collections.abc import Callable
from typing import Any

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_common.messages.gateway import RunOpened
from evopolicy_common.records.blobs import digest_of, write_atomically
from evopolicy_common.records.run_record import PROTOCOL_VERSION
from evopolicy_gateway.run_folder.layout import RunFolder, Staged, save, saved
from evopolicy_gateway.workspace.agents_md import NO_URLS, Urls, agents_md


def variables(folder: RunFolder) -> dict[str, str]:
    """Variables of an agent's process other than the URLs, named as published."""
    return {
        "EVOPOLICYGYM_WORKSPACE": str(folder.workspace),
        "EVOPOLICYGYM_SYSTEM": str(folder.system),
        "EVOPOLICYGYM_FEEDBACK": str(folder.feedback),
        "EVOPOLICYGYM_AGENTS": str(folder.agents_md),
        "EVOPOLICYGYM_PROTOCOL": PROTOCOL_VERSION,
    }


def stage(folder: RunFolder, run: RunOpened, urls: Urls, text: str = "") -> Staged:
    """Creates the workspace of `run`; leaves an existing one unchanged.

    `AGENTS.md` gets mode 0444. `text`: as for `agents_md`. Raises StorageError when the disk refuses.
    """
    if folder.staged.exists():
        return saved(folder.staged, Staged)
    folder.system.mkdir(parents=True, exist_ok=True)
    folder.feedback.mkdir(exist_ok=True)
    path, started = folder.system / "policy.py", folder.start.exists()
    if not started:
        write_atomically(path, initial_policy(run.env.action_space).encode())
    policy = path.read_bytes() if path.exists() else b""  # a start's submit may have been without a policy
    rules = agents_md(run, urls, text, started=started).encode()
    write_atomically(folder.agents_md, rules, mode=0o444)
    staged = Staged(
        rules_hash=digest_of(agents_md(run, NO_URLS, text, started=started).encode()),
        agents_md_hash=digest_of(rules),
        initial_policy_hash=digest_of(policy),
    )
    save(folder.staged, staged)
    return staged


_SOURCE = '''"""A start that works: every action is the same. Replace it."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.action = {action}

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return self.action
'''


def initial_policy(action_space: SpaceSchema) -> str:
    """Source of a policy for this action space; the same for equal spaces."""
    action = pprint.pformat(constant_action(action_space), width=90, compact=True, sort_dicts=False)
    return _SOURCE.replace("{action}", action.replace("\n", "\n" + " " * 22))


def constant_action(space: SpaceSchema) -> object:
    """A plain action inside `space`: zero, else the nearest bound. ValueError for an unknown space."""
    if space["type"] not in _CONSTANT:
        raise ValueError(f"no action for a space of type {space['type']!r}")
    return _CONSTANT[space["type"]](space)


def _in_box(space: SpaceSchema) -> object:
    low, high = space.get("low", space.get("min")), space.get("high", space.get("max"))
    number = float if str(space["dtype"]).startswith("float") else int
    return _box(list(space["shape"]), low, high, number)


_CONSTANT: dict[str, Callable[[SpaceSchema], object]] = {
    "Discrete": lambda space: int(space.get("start", 0)),
    "Box": _in_box,
    "Image": lambda space: _box(space["shape"], space["value_range"][0], space["value_range"][1], int),
    "MultiDiscrete": lambda space: _like(space["nvec"], space.get("start", 0)),
    "MultiBinary": lambda space: _box(
        space["n"] if isinstance(space["n"], list) else [space["n"]], 0, 1, int
    ),
    "Tuple": lambda space: tuple(map(constant_action, space["spaces"])),
    "Dict": lambda space: {key: constant_action(part) for key, part in space["spaces"].items()},
    "Text": lambda space: str(space.get("characters", "a"))[0] * int(space["min_length"]),
    "Sequence": lambda space: [],
    "OneOf": lambda space: (0, constant_action(space["spaces"][0])),
    "Graph": lambda space: {
        "nodes": [constant_action(space["node_space"])],
        "edges": None,
        "edge_links": None,
    },
}


def _box(shape: list[int], low: Any, high: Any, number: type[int] | type[float]) -> object:
    if not shape:
        return number(min(max(0.0, float(low)), float(high)))
    lows, highs = (each if isinstance(each, list) else [each] * shape[0] for each in (low, high))
    return [_box(shape[1:], *bounds, number) for bounds in zip(lows, highs, strict=True)]


def _like(nvec: object, start: Any) -> object:
    """The lowest value of each element of a MultiDiscrete space."""
    if not isinstance(nvec, list):
        return int(start)
    starts = start if isinstance(start, list) else [start] * len(nvec)
    return [_like(part, first) for part, first in zip(nvec, starts, strict=True)]
