"""Compares two records of an episode bit for bit: two trajectories, or a trajectory and feedback files.

Rules that this module owns:
- Floats are compared by their bits, arrays also by dtype and shape. JSON has no dtypes, so each of its numbers is
  read as the dtype of the value that it represents. The texts `"NaN"`, `"Inf"` and `"-Inf"` are read as numbers
  wherever a number belongs.
- An action is an input, not a result: of two trajectories only the results are compared.
- The flag `policy_failed` in an info describes the policy, not the environment, and is ignored.
- Runs from before `info.steps` was recorded have the parts of `info.rewards` in `info` itself, and are read as such.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.records.episodes.columns import leaves
from evopolicy_common.records.episodes.npz import MAX_BYTES, read_arrays
from evopolicy_common.records.episodes.rendered import (
    MAX_OBSERVATIONS_BYTES,
    MAX_ROWS_BYTES,
    OBSERVATIONS,
    ROWS,
    SINGLE,
    files_of,
)
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory
from evopolicy_common.regular_files import read_regular

_NAMES = {"NaN": float("nan"), "Inf": float("inf"), "-Inf": float("-inf")}
_MARKS = frozenset({"policy_failed"})
_NUMBERS = ("t", "reward", "terminated", "truncated")
_HEADER_BYTES = 1 << 16
"""More than the header of an array in a file takes."""


def action_log(actions: Iterable[object]) -> bytes:
    """A trajectory's bytes with these actions and nothing else, for a replay of the episode."""
    recorder = Recorder("actions")
    for action in actions:
        kept = np.asarray(action) if isinstance(action, np.generic) else action
        recorder.append(None, kept, 0.0, False, False, {})
    return recorder.finish()


def episode_difference(
    ours: EpisodeOutcome, recorded: Trajectory, theirs: EpisodeOutcome, replayed: Trajectory
) -> str | None:
    """The first difference of two trajectories of the same actions, or of their outcomes, as `length 3 and 4`; None
    without. Ignores failure, output and times."""
    if difference := first_difference(recorded, replayed):
        return difference
    for name in ("episode_return", "length", "terminated", "truncated", "reward_components"):
        one, other = getattr(ours, name), getattr(theirs, name)
        if not same(one, other):
            return f"{name.replace('_', ' ')} {one!r} and {other!r}"
    return None


def first_difference(recorded: Trajectory, replayed: Trajectory) -> str | None:
    """Describes the first difference of two trajectories, as `step 3: reward 1.0 and 2.0`; None when they are equal.

    Observations and infos are compared only when both have them. If one of the two has been rendered, they are
    compared in the spelling of feedback files, which is unique for a number of a given dtype.
    """
    whole = recorded.record == "full" and replayed.record == "full"
    rendered = bool(recorded.files or replayed.files)
    full = whole and not rendered
    for t in range(min(recorded.n, replayed.n)):
        for name in ("rewards", "terminated", "truncated"):
            ours, theirs = (getattr(each, name)[t].item() for each in (recorded, replayed))
            if not same(ours, theirs):
                return f"step {t}: {name.removesuffix('s')} {ours!r} and {theirs!r}"
        if full and not same(recorded.obs_at(t), replayed.obs_at(t)):
            return f"step {t}: the observations differ"
        if full and not same(*_comparable(recorded.infos[t], replayed.infos[t])):
            return f"step {t}: the infos differ"
    if recorded.n != replayed.n:
        return f"{recorded.n} and {replayed.n} steps"
    return _rendered_difference(recorded, replayed) if whole and rendered else None


def _rendered_difference(recorded: Trajectory, replayed: Trajectory) -> str | None:
    """Describes a difference of observations or infos when at least one side has been rendered."""
    storage: ObsStorage = "inline"
    if OBSERVATIONS in recorded.files or OBSERVATIONS in replayed.files:
        storage = "npz"
    ours, theirs = (files_of(episode, storage) for episode in (recorded, replayed))
    if ours == theirs:
        return None
    lines = zip(ours[ROWS].splitlines(), theirs[ROWS].splitlines(), strict=True)
    for t, (one, other) in enumerate(lines):
        if one != other:
            first, second = json.loads(one), json.loads(other)
            if not same(first["obs"], second["obs"]):
                return f"step {t}: the observations differ"
            if not same(*_comparable(first["info"], second["info"])):
                return f"step {t}: the infos differ"
    arrays = [
        read_arrays(file, MAX_BYTES) if (file := files.get(OBSERVATIONS)) else {} for files in (ours, theirs)
    ]
    return None if same(*arrays) else "the observations differ"


def same(left: Any, right: Any) -> bool:
    """Whether two values have the same type and bits; dicts regardless of the order of their keys."""
    if isinstance(left, np.ndarray | np.generic):
        return (
            isinstance(right, np.ndarray | np.generic)
            and left.dtype == right.dtype
            and left.shape == right.shape
            and left.tobytes() == right.tobytes()
        )
    if type(left) is not type(right):
        return False
    if isinstance(left, float):
        return struct.pack("<d", left) == struct.pack("<d", right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(item, right[key]) for key, item in left.items())
    if isinstance(left, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right)


# ---- feedback files ----


class Rows:
    """The rows of an episode's `trajectory.jsonl`. Each is parsed when it is needed: all may take gigabytes."""

    def __init__(self, folder: Path) -> None:
        """Raises ValueError or OSError when the file cannot be read, or one is no row."""
        self.text = read_regular(folder / ROWS, MAX_ROWS_BYTES)
        self._lines = self.text.splitlines()
        try:
            if not all(isinstance(row, dict) and {"action", "reward"} <= row.keys() for row in self):
                raise ValueError("a row is not one of a trajectory")
        except RecursionError:
            raise ValueError("a row is nested too deeply") from None

    def __len__(self) -> int:
        return len(self._lines)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return map(json.loads, self._lines)


def actions_of(rows: Rows) -> list[Any]:
    """The actions of feedback rows, as close to the policy's actions as JSON allows."""
    return [_action(row["action"]) for row in rows]


def files_difference(
    folder: Path, rows: Rows, episode: Trajectory, *, actions: bool, pictures: bool = True
) -> str | None:
    """Describes the first difference of an episode's feedback files from `episode`; None when they are equal.

    `rows` are those of its `trajectory.jsonl`. `actions`: whether `episode` has the exact actions that the policy
    returned. `pictures`: whether the feedback has the observations that are stored outside the rows. The files of a
    rendered episode are compared by their bytes first, then by their content.
    """
    rendered = episode.files.get(ROWS, b"")
    expected: Iterable[dict[str, Any]] = (row._asdict() for row in episode.rows())
    if rendered:
        expected = map(json.loads, () if rows.text == rendered else rendered.splitlines())
    agree = same if rendered else reads_as
    names = (*_NUMBERS, "action") if actions else _NUMBERS
    for t, (written, row) in enumerate(zip(rows, expected, strict=False)):
        for name in (*names, "obs") if rendered or written.get("obs") is not None else names:
            value = row[name]
            if not agree(written.get(name), value):
                both = (
                    f" {written.get(name)!r} and {value!r}" if isinstance(value, float | bool | int) else ""
                )
                return f"step {t}: {name} differs{both}"
        if not agree(*_comparable(written.get("info") or {}, row["info"])):
            return f"step {t}: info differs"
    if len(rows) != episode.n:
        return f"{len(rows)} and {episode.n} steps"
    if not pictures:
        return None
    return (_file_difference if rendered else _pictures_difference)(folder, rows, episode)


def _file_difference(folder: Path, _: Rows, episode: Trajectory) -> str | None:
    """Describes a difference of a rendered episode's file of observations."""
    stored, expected = folder / OBSERVATIONS, episode.files.get(OBSERVATIONS)
    if expected is None:
        return None
    if not stored.exists():
        return "there is no file of observations"
    data = read_regular(stored, MAX_OBSERVATIONS_BYTES)
    if data == expected:
        return None
    arrays = read_arrays(expected, MAX_BYTES)
    most = sum(array.nbytes + _HEADER_BYTES for array in arrays.values())
    return None if same(read_arrays(data, most), arrays) else f"{OBSERVATIONS} differs"


def reads_as(text: object, value: object) -> bool:
    """Whether the JSON value `text` is the spelling of `value` in feedback files."""
    if isinstance(value, np.ndarray) and not value.ndim:
        value = value[()]
    if isinstance(value, np.ndarray | list | tuple):
        return isinstance(text, list) and len(text) == len(value) and all(map(reads_as, text, value))
    if isinstance(value, np.bool_):
        return text is bool(value)
    if isinstance(value, float | np.floating):
        number = _NAMES.get(text, text) if isinstance(text, str) else text
        if isinstance(number, bool) or not isinstance(number, int | float):
            return False
        try:
            read = np.asarray(number, dtype=np.asarray(value).dtype)
        except OverflowError:
            return False
        return bool(np.isnan(read) and np.isnan(value)) or read.tobytes() == np.asarray(value).tobytes()
    if isinstance(value, np.integer):
        value = int(value)
    if isinstance(value, dict):
        return (
            isinstance(text, dict)
            and text.keys() == {str(key) for key in value}
            and all(reads_as(text[str(key)], item) for key, item in value.items())
        )
    if isinstance(value, bytes):
        value = value.decode("utf-8", "backslashreplace")
    if value is None or isinstance(value, str | bool | int):
        return type(text) is type(value) and bool(text == value)
    return bool(text == str(value))


def _pictures_difference(folder: Path, rows: Rows, episode: Trajectory) -> str | None:
    """Describes a difference of observations that are stored beside the rows."""
    if episode.obs is None or not rows or next(iter(rows)).get("obs") is not None:
        return None
    columns = dict(leaves(episode.obs))
    path = next(
        (folder / name for name in ("observations.npy", "observations.npz") if (folder / name).exists()), None
    )
    if path is None:
        return "there is no file of observations"
    arrays = read_arrays(read_regular(path, MAX_OBSERVATIONS_BYTES), MAX_BYTES)
    if list(columns) == [""] and list(arrays) == [SINGLE]:
        arrays = {"": arrays[SINGLE]}
    if arrays.keys() != columns.keys():
        return f"{path.name}: holds other columns"
    for name, leaf in columns.items():
        column = leaf if isinstance(leaf, np.ndarray) else np.array(leaf, dtype=arrays[name].dtype)
        # The published profiles stack numbers of other sizes.
        common = np.result_type(column, arrays[name])
        one, other = (np.ascontiguousarray(each, dtype=common) for each in (column, arrays[name]))
        if not same(one, other):
            return f"{path.name}: column {name or 'of observations'} differs"
    return None


def _comparable(recorded: dict[str, Any], replayed: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Both infos without ignored keys, the replayed one in the form of the recorded one."""
    ignored = _MARKS
    if "steps" in replayed and "steps" not in recorded:
        ignored = _MARKS | {"steps", "rewards"}
        replayed = replayed | replayed.get("rewards", {})
    recorded, replayed = (
        {key: value for key, value in info.items() if key not in ignored} for info in (recorded, replayed)
    )
    return recorded, replayed


def _action(text: object) -> Any:
    if isinstance(text, str):
        return _NAMES.get(text, text)
    if isinstance(text, list):
        return [_action(item) for item in text]
    if isinstance(text, dict):
        return {key: _action(item) for key, item in text.items()}
    return text
