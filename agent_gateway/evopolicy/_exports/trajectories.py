"""Train episodes as Minari datasets, one for each environment and entry.

Minari wants the observation after the last step, which feedback does not hold: the last observation is repeated there.
The spaces are those of the recorded values, since runs do not record their environment's: unbounded boxes of double
precision for numbers, bytes for pictures, and `Discrete` for whole numbers.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from evopolicy._exports.tables import names
from evopolicy._runs import Run, Runs
from evopolicy_common.errors import ConfigError
from evopolicy_common.records.episodes.npz import MAX_BYTES, read_arrays
from evopolicy_common.records.episodes.rendered import MAX_OBSERVATIONS_BYTES, MAX_ROWS_BYTES
from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.regular_files import open_regular, read_regular
from evopolicy_common.terminal import say

_LAST = "The observation after an episode's last step is a copy of the one before it."


def write_minari(runs: Runs, out: Path) -> list[Path]:
    """Writes datasets named `evopolicy/<environment>/<entry>-v0` below `out`; `MINARI_DATASETS_PATH=out` reads them.

    Entries whose names are equal but for other characters than ASCII letters and digits get a digest before `-v0`.
    Episodes whose values fit no space, or not that of the others, are left out and named on stderr. Raises ConfigError
    when a dataset is there already, or when no run has trajectories.
    """
    os.environ["MINARI_DATASETS_PATH"] = str(out.absolute())
    import minari
    from minari.serialization import deserialize_space

    known_as = names(runs)
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.summary.env, run.summary.entry), []).append(run)
    slugs = {key: f"evopolicy/{_slug(key[0])}/{_slug(key[1])}" for key in groups}
    shared = Counter(slugs.values())
    written = []
    for key, members in groups.items():
        name = slugs[key] + (f"-{_digest(key)}" if shared[slugs[key]] > 1 else "") + "-v0"
        if (out / name).exists():
            raise ConfigError(f"{out / name} is there already; remove it, or choose another --out")
        episodes = [each for run in members for each in _episodes(run, known_as[str(run.folder)])]
        if not episodes:
            continue
        buffers, about = _of_one_form(episodes)
        first = members[0].summary
        with warnings.catch_warnings():
            # Minari warns of an author, a link and an environment that runs do not name.
            warnings.simplefilter("ignore", UserWarning)
            dataset = minari.create_dataset_from_buffers(
                name,
                buffers,
                observation_space=deserialize_space(_space([each.observations for each in buffers])),
                action_space=deserialize_space(_space([each.actions for each in buffers])),
                algorithm_name=first.entry,
                description=f"Train episodes of {first.entry} on {first.env}, from evopolicy's feedback. {_LAST}",
                data_format="arrow",
                jpeg_encoding=False,
            )
        dataset.storage.update_episode_metadata(about)
        written.append(out / name)
    if not written:
        raise ConfigError(
            "no run here has trajectories: its agent was shown scores only, or its submits failed"
        )
    return written


def _of_one_form(episodes: list[tuple[Any, dict[str, Any]]]) -> tuple[list[Any], list[dict[str, Any]]]:
    """The episodes whose values have the most common form, renumbered; the others, whose policy returned something
    else, are named."""
    forms = [str((_form(buffer.observations), _form(buffer.actions))) for buffer, _ in episodes]
    usual = Counter(forms).most_common(1)[0][0]
    buffers: list[Any] = []
    kept: list[dict[str, Any]] = []
    for (buffer, about), form in zip(episodes, forms, strict=True):
        if form == usual:
            buffers.append(replace(buffer, id=len(buffers)))
            kept.append(about)
        else:
            _left_out(about, "its values have another form than those of the other episodes")
    return buffers, kept


def _form(columns: Any) -> Any:
    if isinstance(columns, dict):
        return {name: _form(one) for name, one in sorted(columns.items())}
    return "text" if isinstance(columns, list) else (columns.dtype.kind, columns.shape[1:])


def _left_out(about: dict[str, object], why: str) -> None:
    say(f"{about['run']}: submit {about['submit']}, episode {about['episode']}: left out: {why}", err=True)


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-") or "x"


def _digest(key: tuple[str, str]) -> str:
    """Tells datasets apart whose names have no other letters and digits."""
    return hashlib.sha256("\n".join(key).encode(errors="backslashreplace")).hexdigest()[:8]


def _episodes(run: Run, name: str) -> Iterator[tuple[Any, dict[str, Any]]]:
    """A buffer and its metadata for each recorded train episode."""
    from minari.data_collector import EpisodeBuffer

    returns = {(one.submit, one.episode): one for one in run.episodes if one.split == "train"}
    folders = {one.index: one.feedback for one in read_submits(run.folder)}
    for submit in run.submits:
        # Each folder counts, also one whose trajectory was left out.
        for episode, folder in enumerate(sorted((folders[submit.submit] / "episodes").glob("ep_*"))):
            path = folder / "trajectory.jsonl"
            if not path.is_file():
                continue
            known = returns.get((submit.submit, episode))
            about = {
                "run": name,
                "submit": submit.submit,
                "episode": episode,
                "policy_mean_return": submit.mean_return,
                "case": known and known.case,
                "episode_return": known and known.episode_return,
                "failed": known and known.failed,
            }
            pictures = [path.with_name(f"observations.{kind}") for kind in ("npz", "npy")]
            try:
                rows = list(_rows(path))
                if rows and rows[0].obs is not None:
                    columns = _columns([row.obs for row in rows])
                elif rows and (stored := [one for one in pictures if one.is_file()]):
                    columns = read_arrays(read_regular(stored[0], MAX_OBSERVATIONS_BYTES), MAX_BYTES)
                    if list(columns) in ([""], ["observations"]):
                        (columns,) = columns.values()
                else:
                    continue
                actions = _columns([row.action for row in rows])
            except (TypeError, ValueError, KeyError, OverflowError):
                _left_out(about, "it has values without a fixed form, such as actions of several kinds")
                continue
            buffer = EpisodeBuffer(
                observations=_repeat_last(columns),
                actions=actions,
                rewards=[row.reward for row in rows],
                terminations=[row.terminated for row in rows],
                truncations=[row.truncated for row in rows],
            )
            yield buffer, about


class _Row(NamedTuple):
    """The values of a step, with arrays for lists of numbers: a row as it was read takes ten times as much memory."""

    obs: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool


def _rows(path: Path) -> Iterator[_Row]:
    """The steps of an episode. Raises as `_columns`, and OSError for a file longer than any trajectory."""
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > MAX_ROWS_BYTES:
            raise OSError(errno.EFBIG, f"larger than {MAX_ROWS_BYTES:,} bytes, the limit", str(path))
        for line in file:
            row = json.loads(line)
            values = _packed(row["obs"]), _packed(row["action"]), _number(row["reward"])
            yield _Row(*values, row["terminated"], row["truncated"])


def _packed(value: object) -> Any:
    import numpy as np

    if isinstance(value, dict):
        return {name: _packed(each) for name, each in value.items()}
    return np.asarray(_floats(value), dtype=np.float64) if isinstance(value, list) else value


def _number(value: Any) -> float:
    return float(value)  # also of `NaN`, `Inf` and `-Inf`


def _columns(values: list[Any]) -> Any:
    """Values of one structure, a step each, as arrays: a dict of them for dicts, a list of texts for texts.

    Raises TypeError, ValueError, KeyError or OverflowError for values without a fixed form.
    """
    import numpy as np

    first = values[0]
    if isinstance(first, dict):
        return {name: _columns([value[name] for value in values]) for name in first}
    if isinstance(first, str) and first not in ("NaN", "Inf", "-Inf"):
        if not all(isinstance(value, str) for value in values):
            raise TypeError("not only texts")
        return list(values)
    if isinstance(first, bool) or all(isinstance(value, int) for value in values):
        return np.asarray(values, dtype=np.int64)
    if isinstance(first, np.ndarray):
        return np.stack(values)
    return np.asarray(_floats(values), dtype=np.float64)


def _floats(value: object) -> Any:
    return [_floats(each) for each in value] if isinstance(value, list) else _number(value)


def _repeat_last(columns: Any) -> Any:
    import numpy as np

    if isinstance(columns, dict):
        return {name: _repeat_last(one) for name, one in columns.items()}
    if isinstance(columns, list):
        return [*columns, columns[-1]]
    return np.concatenate([columns, columns[-1:]])


def _space(columns: list[Any]) -> dict[str, Any]:
    """The space of these episodes' values, in Minari's own description of spaces."""
    import numpy as np

    first = columns[0]
    if isinstance(first, dict):
        parts = {name: _space([one[name] for one in columns]) for name in first}
        return {"type": "Dict", "subspaces": parts}
    if isinstance(first, list):
        texts = [text for one in columns for text in one]
        letters = "".join(sorted({*"".join(texts)})) or " "
        return {"type": "Text", "min_length": 0, "max_length": max(1, *map(len, texts)), "charset": letters}
    if first.ndim == 1 and first.dtype.kind == "i":
        low, high = min(int(one.min()) for one in columns), max(int(one.max()) for one in columns)
        return {"type": "Discrete", "start": low, "n": high - low + 1}
    shape = first.shape[1:]
    bottom, top = (0.0, 255.0) if first.dtype == np.uint8 else (-np.inf, np.inf)
    bounds = {"low": np.full(shape, bottom), "high": np.full(shape, top)}
    return {"type": "Box", "dtype": str(first.dtype), "shape": shape, **bounds}
