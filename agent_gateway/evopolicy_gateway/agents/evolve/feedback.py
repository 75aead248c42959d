"""Reads a submit's files in `feedback/`, the agent's only source of its candidates' results.

A summary is small and always read; of a trajectory, which may be large, only as much as the caller needs.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from evopolicy_gateway.agents.evolve.evolved.controllers import fingerprint

NAMED_NUMBERS = {"NaN": float("nan"), "Inf": float("inf"), "-Inf": float("-inf")}


@dataclass(frozen=True, kw_only=True)
class Step:
    """One row of a trajectory."""

    obs: Any
    """The observation that the policy received, as JSON; None if observations are stored outside the rows."""
    action: Any
    reward: float
    terminated: bool


def episode_folders(
    workspace: Path, submit_id: str, n_episodes: int, first_global_episode: int
) -> list[Path]:
    """Folders of the submit's episodes in request order; they need not exist (submits that are not ok have none)."""
    folder = workspace / "feedback" / submit_id / "episodes"
    if not folder.is_dir():
        return []
    present = {int(path.name.removeprefix("ep_")): path for path in folder.glob("ep_*")}
    wanted = range(first_global_episode, first_global_episode + n_episodes)
    return [present.get(index, folder / f"ep_{index:03d}") for index in wanted]


def read_steps(episode: Path, max_rows: int) -> list[Step]:
    """The first `max_rows` rows of an episode's trajectory; none if it has no trajectory."""
    path = episode / "trajectory.jsonl"
    if not path.is_file():
        return []
    with path.open(encoding="utf-8") as lines:
        return [_step(json.loads(line)) for line in islice(lines, max_rows)]


def _step(row: dict[str, Any]) -> Step:
    return Step(
        obs=_numbers(row.get("obs")),
        action=_numbers(row.get("action")),
        reward=float(_numbers(row.get("reward")) or 0.0),
        terminated=bool(row.get("terminated")),
    )


def _numbers(value: Any) -> Any:
    """Returns `value` with `"NaN"`, `"Inf"` and `"-Inf"` as floats; other strings are unchanged."""
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return NAMED_NUMBERS.get(value, value) if isinstance(value, str) else value


def novelty(steps: list[Step]) -> int:
    """Number of different observations in an episode: a measure of progress without rewards."""
    return len({fingerprint(step.obs) for step in steps if step.obs is not None})
