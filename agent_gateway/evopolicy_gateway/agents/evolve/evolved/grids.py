"""Navigates by a small grid of symbols around the agent, such as a partial view of rooms.

How the view moves with each action, which cell advancing touches and which symbols block the way is identified from
trajectories (`views.py` on the agent's side). With this model the seeker plans in its view: it walks to symbols that
were rewarded before, else to rare symbols and tries every action on them, else to a random visible place.

Settings: `key`, the part of a Dict observation that holds the grid, or None; `maps`, for each action that moves the
view, the cell from which each cell's symbol comes, -1 if unknown; `advance`, the action that blocked cells stop;
`touch`, the cell it enters; `blocked`, symbols that stop it; `rare`, symbols worth touching; `prizes`, rewarded pairs
[symbol, action].
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .spaces import Given, Schema, Vector

MAX_GRID_SIDE = 15
MAX_VIEWS_PLANNED = 400
"""Most different views that one plan examines."""

Symbols = NDArray[np.int32]


def find_grid(schema: Schema) -> tuple[bool, str | None]:
    """Whether the space contains a grid of symbols, and its key in a Dict (None at the top level)."""
    parts = {None: schema} | (schema["spaces"] if schema["type"] == "Dict" else {})
    keys = [key for key, part in parts.items() if _is_grid(part)]
    return bool(keys), keys[0] if keys else None


def _is_grid(schema: Schema) -> bool:
    if schema["type"] != "Box" or np.dtype(schema["dtype"]).kind not in "iu":
        return False
    shape = schema["shape"]
    return len(shape) in (2, 3) and min(shape[:2]) >= 3 and max(shape[:2]) <= MAX_GRID_SIDE


def read_symbols(obs: Any, key: str | None) -> Symbols:
    """The grid as one number per cell, flat int32; cells with equal values in all channels get equal numbers."""
    grid = np.asarray(obs if key is None else obs[key], dtype=np.int32)
    if grid.ndim == 2:
        return grid.reshape(-1)
    flat = grid.reshape(-1, grid.shape[2])
    symbols: Symbols = flat @ (256 ** np.arange(grid.shape[2], dtype=np.int32))
    return symbols


class GridSeeker:
    """Parameters: the appeal of rare symbols, the appeal of distant places, the share of random actions."""

    def __init__(self, given: Given, vector: Vector) -> None:
        self._head, self._rng, settings = given.head, given.rng, given.settings
        self._key = settings["key"]
        self._maps = {int(action): np.array(cells) for action, cells in settings["maps"].items()}
        self._advance, self._touch = int(settings["advance"]), int(settings["touch"])
        self._blocked = set(settings["blocked"])
        self._rare = set(settings["rare"])
        self._prizes = {int(symbol): int(action) for symbol, action in settings["prizes"]}
        self._handling = [a for a in range(self._head.size) if a not in self._maps]
        self._rare_appeal, self._distance_appeal = float(2.0 ** vector[0]), float(vector[1])
        self._random_share = 0.04 * float(2.0 ** np.clip(vector[2], -4, 4))
        self._queue: deque[int] = deque()
        self._last: tuple[Symbols, int] | None = None
        self._visits: dict[int, int] = {}

    def act(self, obs: Any) -> Any:
        seen = read_symbols(obs, self._key)
        self._notice(seen)
        if self._rng.random() < self._random_share:
            self._queue.clear()
            action = int(self._rng.integers(self._head.size))
        else:
            if not self._queue or any(int(s) in self._prizes for s in seen):
                self._queue = deque(self._decide(seen))
            action = self._queue.popleft()
        self._last = seen, action
        return self._head.action(np.eye(self._head.size)[action])

    def _notice(self, seen: Symbols) -> None:
        """Drops a plan that was stopped; advances if an action on something has cleared the way."""
        if self._last is None:
            return
        before, action = self._last
        if action in self._maps:
            if np.array_equal(before, seen):
                self._queue.clear()
                if action == self._advance:
                    self._queue.append(self._any_turn())
        elif before[self._touch] != seen[self._touch]:
            self._visits.pop(int(before[self._touch]), None)
            self._queue = deque([self._advance])

    def _any_turn(self) -> int:
        turns = [a for a in self._maps if a != self._advance] or list(self._maps)
        return int(turns[int(self._rng.integers(len(turns)))])

    def _decide(self, seen: Symbols) -> list[int]:
        """The next actions, at least one."""
        ways = self._ways(seen)
        prizes = [cell for cell in ways if int(seen[cell]) in self._prizes]
        if prizes:
            cell = min(prizes, key=lambda c: len(ways[c]))
            return [*ways[cell], self._prizes[int(seen[cell])]]
        for cell in (cell for cell in ways if int(seen[cell]) in self._rare):
            symbol = int(seen[cell])
            visits = self._visits.get(symbol, 0)
            if self._rng.random() < self._rare_appeal / (self._rare_appeal + visits**2):
                self._visits[symbol] = visits + 1
                handling = [self._handling[i] for i in self._rng.permutation(len(self._handling))]
                return [*ways[cell], *handling, self._advance]
        free = [cell for cell in ways if int(seen[cell]) not in self._blocked]
        if not free:
            return [self._any_turn()]
        length = np.array([len(ways[cell]) for cell in free], dtype=float)
        chances = (1.0 + length) ** np.clip(1.0 + self._distance_appeal, -2, 4)
        cell = free[int(self._rng.choice(len(free), p=chances / chances.sum()))]
        return [*ways[cell], self._advance]

    def _ways(self, seen: Symbols) -> dict[int, list[int]]:
        """For each cell that can become the touched cell, the shortest list of actions to get there."""
        here = np.arange(seen.size)
        ways: dict[int, list[int]] = {}
        known = {here.tobytes()}
        open_views = deque([(here, list[int]())])
        while open_views and len(known) < MAX_VIEWS_PLANNED:
            view, actions = open_views.popleft()
            touched = int(view[self._touch])
            if touched >= 0:
                ways.setdefault(touched, actions)
            for action, cells in self._maps.items():
                stops = touched < 0 or int(seen[touched]) in self._blocked or int(seen[touched]) in self._rare
                if action == self._advance and stops:
                    continue
                moved = np.where(cells >= 0, view[cells], -1)
                name = moved.tobytes()
                if name not in known:
                    known.add(name)
                    open_views.append((moved, [*actions, action]))
        return ways
