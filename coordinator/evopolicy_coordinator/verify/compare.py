"""Whether two records of an episode are the same, bit for bit: two trajectories, or a trajectory and feedback files.

Rules that this module owns:
- Floats are compared by their bits, arrays also by dtype and shape; of JSON, which has no dtypes, each number is read as
  the dtype of what it stands for. The texts `"NaN"`, `"Inf"` and `"-Inf"` are numbers wherever one belongs.
- An action is what was played, not part of what came of it: of two trajectories only the answers to it are compared.
- The mark `policy_failed` in an info is of the policy, not of the environment, and is left out.
- Runs from before `info.steps` was recorded have the parts of `info.rewards` in `info` itself; they are read as such.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.records.columns import leaves
from evopolicy_common.records.rendered import OBSERVATIONS, ROWS, SINGLE, files_of
from evopolicy_common.records.trajectory import Recorder, Trajectory

_NAMES = {"NaN": float("nan"), "Inf": float("inf"), "-Inf": float("-inf")}
_MARKS = frozenset({"policy_failed"})


def recorded_actions(recording: Trajectory) -> bytes:
    """The actions of a recording and nothing that came of them: what is given to who plays the episode again."""
    return action_log(recording.actions)


def action_log(actions: Iterable[Any]) -> bytes:
    """A trajectory's bytes with these actions and nothing else."""
    recorder = Recorder("actions")
    for action in actions:
        kept = np.asarray(action) if isinstance(action, np.generic) else action
        recorder.append(None, kept, 0.0, False, False, {})
    return recorder.finish()


def episode_difference(
    ours: EpisodeOutcome, recorded: Trajectory, theirs: EpisodeOutcome, replayed: Trajectory
) -> str | None:
    """Where two outcomes of the same actions and their trajectories part, in words; None when they never do."""
    return first_difference(recorded, replayed) or outcome_difference(ours, theirs)


def first_difference(recorded: Trajectory, replayed: Trajectory) -> str | None:
    """Where two trajectories part, as `step 3: reward 1.0 and 2.0`; None when they never do.

    Observations and infos are compared only where both have them; as they are spelled in feedback files where one of the two
    has been rendered as such. A number of one dtype is spelled in one way.
    """
    whole = recorded.record == "full" and replayed.record == "full"
    rendered = bool(recorded.files or replayed.files)
    full = whole and not rendered
    for t in range(min(recorded.n, replayed.n)):
        for what, ours, theirs in (
            ("reward", float(recorded.rewards[t]), float(replayed.rewards[t])),
            ("terminated", bool(recorded.terminated[t]), bool(replayed.terminated[t])),
            ("truncated", bool(recorded.truncated[t]), bool(replayed.truncated[t])),
        ):
            if not same(ours, theirs):
                return f"step {t}: {what} {ours!r} and {theirs!r}"
        if full and not same(recorded.obs_at(t), replayed.obs_at(t)):
            return f"step {t}: the observations differ"
        if full and not same(*_comparable(recorded.infos[t], replayed.infos[t])):
            return f"step {t}: the infos differ"
    if recorded.n != replayed.n:
        return f"{recorded.n} and {replayed.n} steps"
    return _rendered_difference(recorded, replayed) if whole and rendered else None


def _rendered_difference(recorded: Trajectory, replayed: Trajectory) -> str | None:
    """Where observations or infos part, of which at least one has been rendered."""
    storage: ObsStorage = "inline"
    if OBSERVATIONS in recorded.files or OBSERVATIONS in replayed.files:
        storage = "npz"
    ours, theirs = (files_of(episode, storage) for episode in (recorded, replayed))
    if ours == theirs:
        return None
    lines = zip(ours[ROWS].splitlines(), theirs[ROWS].splitlines(), strict=True)
    for t, (one, other) in enumerate(lines):
        if one != other:
            left, right = json.loads(one), json.loads(other)
            if not same(left["obs"], right["obs"]):
                return f"step {t}: the observations differ"
            if not same(*_comparable(left["info"], right["info"])):
                return f"step {t}: the infos differ"
    found, expected = (_arrays(files.get(OBSERVATIONS)) for files in (ours, theirs))
    return "the observations differ" if not same(found, expected) else None


def _arrays(file: bytes | None) -> dict[str, Any]:
    if file is None:
        return {}
    with np.load(io.BytesIO(file), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def outcome_difference(ours: EpisodeOutcome, theirs: EpisodeOutcome) -> str | None:
    """Which of an episode's own numbers differ, as `length 3 and 4`; the policy's side (failure, output, times) is left out."""
    for name in ("episode_return", "length", "terminated", "truncated", "reward_components"):
        one, other = getattr(ours, name), getattr(theirs, name)
        if not same(one, other):
            return f"{name.replace('_', ' ')} {one!r} and {other!r}"
    return None


def same(left: Any, right: Any) -> bool:
    """Whether two values are of one type and the same bits; dicts whatever the order of their keys."""
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


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of an episode's `trajectory.jsonl`. ValueError or OSError when it cannot be read."""
    try:
        rows = [json.loads(line) for line in (folder / "trajectory.jsonl").read_bytes().splitlines()]
    except RecursionError:
        raise ValueError("a row is nested too deeply") from None
    if not all(isinstance(row, dict) and {"action", "reward"} <= row.keys() for row in rows):
        raise ValueError("a row is not one of a trajectory")
    return rows


def actions_of(rows: list[dict[str, Any]]) -> list[Any]:
    """The actions of feedback rows, as near to what the policy returned as JSON can be."""
    return [_action(row["action"]) for row in rows]


def files_difference(
    folder: Path, rows: list[dict[str, Any]], episode: Trajectory, *, actions: bool
) -> str | None:
    """Where an episode's feedback files part from `episode`; None when they say the same.

    `rows` are those of its `trajectory.jsonl`; `actions`: whether `episode` has the very actions that were returned.
    """
    if episode.files:
        return _written_difference(folder, rows, episode, actions=actions)
    for t, (told, row) in enumerate(zip(rows, episode.rows(), strict=False)):
        pairs: list[tuple[str, Any]] = [
            ("t", row.t),
            ("reward", row.reward),
            ("terminated", row.terminated),
            ("truncated", row.truncated),
        ]
        if actions:
            pairs.append(("action", row.action))
        if told.get("obs") is not None:
            pairs.append(("obs", row.obs))
        for name, value in pairs:
            if not reads_as(told.get(name), value):
                shown = f" {told.get(name)!r} and {value!r}" if isinstance(value, float | bool | int) else ""
                return f"step {t}: {name} differs{shown}"
        if not reads_as(*_comparable(told.get("info") or {}, row.info)):
            return f"step {t}: info differs"
    if len(rows) != episode.n:
        return f"{len(rows)} and {episode.n} steps"
    return _pictures_difference(folder, rows, episode)


def _written_difference(
    folder: Path, rows: list[dict[str, Any]], episode: Trajectory, *, actions: bool
) -> str | None:
    """`files_difference` of an episode that was rendered: its files by their bytes, then by what they say."""
    lines = episode.files[ROWS].splitlines()
    if (folder / ROWS).read_bytes() != episode.files[ROWS]:
        for t, (told, line) in enumerate(zip(rows, lines, strict=False)):
            ours = json.loads(line)
            for name in ("t", "reward", "terminated", "truncated", *(("action",) if actions else ()), "obs"):
                if not same(told.get(name), ours[name]):
                    return f"step {t}: {name} differs"
            if not same(*_comparable(told.get("info") or {}, ours["info"])):
                return f"step {t}: info differs"
    if len(rows) != len(lines):
        return f"{len(rows)} and {len(lines)} steps"
    stored, expected = folder / OBSERVATIONS, episode.files.get(OBSERVATIONS)
    if expected is None:
        return None
    if not stored.exists():
        return "there is no file of observations"
    data = stored.read_bytes()
    if data != expected and not same(_arrays(data), _arrays(expected)):
        return f"{OBSERVATIONS} differs"
    return None


def reads_as(told: Any, value: Any) -> bool:
    """Whether the JSON value `told` is how feedback files say `value`."""
    if isinstance(value, np.ndarray) and value.ndim:
        return (
            isinstance(told, list)
            and len(told) == len(value)
            and all(reads_as(item, part) for item, part in zip(told, value, strict=True))
        )
    if isinstance(value, np.ndarray):
        value = value[()]
    if isinstance(value, np.bool_):
        return told is bool(value)
    if isinstance(value, float | np.floating):
        number = _NAMES.get(told, told) if isinstance(told, str) else told
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
            isinstance(told, dict)
            and told.keys() == {str(key) for key in value}
            and all(reads_as(told[str(key)], item) for key, item in value.items())
        )
    if isinstance(value, list | tuple):
        return (
            isinstance(told, list)
            and len(told) == len(value)
            and all(reads_as(item, part) for item, part in zip(told, value, strict=True))
        )
    if isinstance(value, bytes):
        value = value.decode("utf-8", "backslashreplace")
    if value is None or isinstance(value, str | bool | int):
        return type(told) is type(value) and bool(told == value)
    return bool(told == str(value))


def _pictures_difference(folder: Path, rows: list[dict[str, Any]], episode: Trajectory) -> str | None:
    """Of observations that are stored beside the rows."""
    if episode.obs is None or not rows or rows[0].get("obs") is not None:
        return None
    columns = dict(leaves(episode.obs))
    path = next(
        (folder / name for name in ("observations.npy", "observations.npz") if (folder / name).exists()), None
    )
    if path is None:
        return "there is no file of observations"
    stored = np.load(path, allow_pickle=False)
    if isinstance(stored, np.ndarray):
        found = {"": stored}
    else:
        with stored:
            found = {name: stored[name] for name in stored.files}
    if list(columns) == [""] and list(found) == [SINGLE]:
        found = {"": found[SINGLE]}
    if found.keys() != columns.keys():
        return f"{path.name}: holds other columns"
    for name, leaf in columns.items():
        column = leaf if isinstance(leaf, np.ndarray) else np.array(leaf, dtype=found[name].dtype)
        if not same(np.ascontiguousarray(column), np.ascontiguousarray(found[name])):
            return f"{path.name}: column {name or 'of observations'} differs"
    return None


def _comparable(recorded: dict[str, Any], replayed: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Both infos without marks, the replayed one in the recorded one's form."""
    left_out = _MARKS
    if "steps" in replayed and "steps" not in recorded:
        left_out = _MARKS | {"steps", "rewards"}
        replayed = replayed | replayed.get("rewards", {})
    recorded, replayed = (
        {key: value for key, value in info.items() if key not in left_out} for info in (recorded, replayed)
    )
    return recorded, replayed


def _action(told: Any) -> Any:
    if isinstance(told, str):
        return _NAMES.get(told, told)
    if isinstance(told, list):
        return [_action(item) for item in told]
    if isinstance(told, dict):
        return {key: _action(item) for key, item in told.items()}
    return told
