"""Identifies from trajectories how a grid of symbols moves with the actions, as the seeker needs it to plan in its
view.

- A cell's symbol comes from the cell whose symbols before the action agreed with it most, with rare symbols weighted
  more.
- Advancing is the action for which one cell's symbol predicts best whether the action moves the view or is stopped.
- Turns leave one cell in its place: the agent's own. The cell that advancing would bring there is the cell that
  advancing enters. If turns leave no such cell, the best predicting cell is used.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evopolicy_gateway.agents.evolve.evolved.grids import find_grid, read_symbols
from evopolicy_gateway.agents.evolve.evolved.spaces import Schema
from evopolicy_gateway.agents.evolve.feedback import Step

MIN_MOVES = 25
"""Least number of transitions in which an action changed the view, to learn its map."""
MAX_MOVES = 1500
MIN_AGREEMENT = 0.7
MIN_MAPPED_SHARE = 0.3
MAX_STILL_SHARE = 0.7
MIN_SEEN = 8
"""How often a symbol must have been met at the touched cell before it can count as blocking."""
RARE_FRAMES = 0.3
"""A symbol is rare when fewer than this share of the frames contain it."""

Symbols = NDArray[np.int32]


class ViewLog(NamedTuple):
    """One episode as arrays."""

    frames: Symbols
    """Shape (steps, cells)."""
    actions: NDArray[np.int64]
    """Shape (steps,), from 0."""
    rewards: NDArray[np.float64]
    """Shape (steps,)."""


def view_logs(obs_space: Schema, action_space: Schema, episodes: list[list[Step]]) -> list[ViewLog]:
    """The episodes as logs of the grid in their observations; none without a grid or a Discrete action space."""
    exists, key = find_grid(obs_space)
    if not exists or action_space["type"] != "Discrete":
        return []
    first = int(action_space.get("start", 0))
    return [
        ViewLog(
            np.array([read_symbols(step.obs, key) for step in steps]),
            np.array([int(step.action) - first for step in steps]),
            np.array([step.reward for step in steps]),
        )
        for steps in episodes
        if len(steps) > 1 and steps[0].obs is not None
    ]


def find_views(obs_space: Schema, action_space: Schema, runs: list[ViewLog]) -> dict[str, Any] | None:
    """Settings for the `seeker` controller; None if the logs do not determine them."""
    if not runs:
        return None
    frames = np.concatenate([run.frames for run in runs])
    before = np.concatenate([run.frames[:-1] for run in runs])
    after = np.concatenate([run.frames[1:] for run in runs])
    actions = np.concatenate([run.actions[:-1] for run in runs])
    changed_cells = (before != after).sum(axis=1)
    maps = {}
    for action in range(action_space["n"]):
        moved = np.flatnonzero((actions == action) & (changed_cells > 1))[:MAX_MOVES]
        if len(moved) >= MIN_MOVES and len(moved) > 0.1 * np.count_nonzero(actions == action):
            cells = _source_cells(before[moved], after[moved], frames)
            mapped = np.flatnonzero(cells >= 0)
            stays = int(np.count_nonzero(cells[mapped] == mapped))
            if len(mapped) > MIN_MAPPED_SHARE * len(cells) and stays <= MAX_STILL_SHARE * len(mapped):
                maps[action] = cells
    outputs = _advance_and_touch(before, actions, changed_cells > 1, maps)
    if outputs is None:
        return None
    advance, touch = outputs
    # Symbols that stopped the advance more often than not, those that let it pass, and those in few frames.
    advanced = actions == advance
    passing = {
        int(symbol): (changed_cells > 1)[advanced & (before[:, touch] == symbol)]
        for symbol in np.unique(before[advanced, touch])
    }
    blocked = {one for one, went in passing.items() if len(went) >= MIN_SEEN and went.mean() < 0.5}
    passed = {one for one, went in passing.items() if went.mean() >= 0.5}
    shown = Counter(symbol for frame in frames for symbol in set(frame.tolist()))
    rare = {symbol for symbol, count in shown.items() if count < RARE_FRAMES * len(frames)}
    return {
        "key": find_grid(obs_space)[1],
        "maps": {str(action): cells.tolist() for action, cells in maps.items()},
        "advance": advance,
        "touch": touch,
        "blocked": sorted(blocked),
        "rare": sorted(rare - passed),
        "prizes": _prizes(runs, touch),
    }


def _source_cells(before: Symbols, after: Symbols, frames: Symbols) -> Symbols:
    """For each cell, the cell from which its symbol comes; -1 if none agrees well enough. Symbols weigh -log of their
    share of all cells in `frames`."""
    n_cells = before.shape[1]
    symbols, counts = np.unique(frames, return_counts=True)
    rarity = -np.log(counts / frames.size)
    weight_before, weight_after = (rarity[np.searchsorted(symbols, view)] for view in (before, after))
    agreement = np.empty((n_cells, n_cells))
    for cell in range(n_cells):
        same = before == after[:, cell : cell + 1]
        shared = (same * weight_before).sum(axis=0)
        whole = np.sqrt(weight_before.sum(axis=0) * weight_after[:, cell].sum())
        agreement[cell] = shared / np.maximum(whole, 1e-9)
    best = agreement.argmax(axis=1)
    return np.where(agreement.max(axis=1) >= MIN_AGREEMENT, best, -1).astype(np.int32)


def _advance_and_touch(
    before: Symbols, actions: Symbols, moved: NDArray[np.bool_], maps: dict[int, Symbols]
) -> tuple[int, int] | None:
    """The action that may be stopped, and the cell it would enter; None if no action is ever stopped."""
    best = (0.05, -1, -1)  # bits; less tells nothing
    for action in maps:
        rows = actions == action
        outcome = moved[rows]
        if not 0.02 < outcome.mean() < 0.98:
            continue
        for cell in range(before.shape[1]):
            gained = _information(before[rows, cell], outcome)
            best = max(best, (gained, action, cell))
    _, advance, telling = best
    if advance < 0:
        return None
    turns = [cells for action, cells in maps.items() if action != advance]
    own = np.arange(before.shape[1])
    standing = np.flatnonzero(np.all([cells == own for cells in turns], axis=0)) if turns else own[:0]
    if len(standing) != 1:
        return advance, telling
    mapped = np.flatnonzero(maps[advance] >= 0)
    shifts, counts = np.unique(maps[advance][mapped] - mapped, return_counts=True)
    return advance, int(np.clip(standing[0] + shifts[counts.argmax()], 0, own[-1]))


def _information(symbols: Symbols, outcome: NDArray[np.bool_]) -> float:
    """Mutual information between a symbol and a binary outcome, bits."""
    kinds = np.unique(symbols, return_inverse=True)[1]
    n = np.bincount(kinds)
    yes = np.bincount(kinds, outcome)
    return float(_entropy(outcome.mean()) - (n / n.sum() * _entropy(yes / n)).sum())


def _entropy(p: Any) -> Any:
    """Of binary outcomes with chances `p`, bits."""
    q = np.clip(p, 1e-12, 1 - 1e-12)
    return -(q * np.log2(q) + (1 - q) * np.log2(1 - q))


def _prizes(runs: list[ViewLog], touch: int) -> list[list[int]]:
    """Pairs [symbol at the touched cell, action] of rewarded steps; none unless rewards are rare."""
    rewards = np.concatenate([run.rewards for run in runs])
    if np.mean(rewards > 0) > 0.05:
        return []
    pairs = Counter(
        (int(run.frames[t, touch]), int(run.actions[t]))
        for run in runs
        for t in np.flatnonzero(run.rewards > 0)
    )
    usual = dict(sorted(pairs, key=lambda pair: (pairs[pair], pair)))
    return [list(pair) for pair in sorted(usual.items())]
