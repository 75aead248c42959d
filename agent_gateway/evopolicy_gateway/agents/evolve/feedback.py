"""Reads a submit's trajectories in `feedback/`."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from evopolicy_gateway.agents.evolve.evolved.controllers import fingerprint

MAX_ROWS_READ = 3000
"""Most rows that are read of one trajectory."""
NAMED_NUMBERS = {"NaN": float("nan"), "Inf": float("inf"), "-Inf": float("-inf")}


class Step(NamedTuple):
    """One row of a trajectory."""

    obs: Any
    """The observation that the policy received, as JSON; None if observations are stored outside the rows."""
    action: Any
    reward: float


def read_episodes(submit: Path, episodes: range) -> list[list[Step]]:
    """The steps of a submit's episodes, by their numbers in the run; none where an episode has no trajectory."""
    present = {int(path.name.removeprefix("ep_")): path for path in (submit / "episodes").glob("ep_*")}
    return [_steps(present[number] / "trajectory.jsonl") if number in present else [] for number in episodes]


def _steps(path: Path) -> list[Step]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8") as lines:
        rows = [_numbers(json.loads(line)) for line in islice(lines, MAX_ROWS_READ)]
    return [Step(row.get("obs"), row.get("action"), float(row.get("reward") or 0.0)) for row in rows]


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
