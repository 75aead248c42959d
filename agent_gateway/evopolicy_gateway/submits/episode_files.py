"""One episode's folder in the feedback tree, as file names and bytes; pure.

A level of detail that hides observations also leaves out the policy's own texts (stdout, stderr, messages of its
errors), since a policy could write its observations there.

In the published profiles, observations are where the published software (v0.1.0) has them. Where the stacked ones of an
episode take more than `MOST_INLINE_BYTES`, they are in `observations.npy`, or in `observations.npz` for flat
dictionaries, whose arrays are summed, and every row has `obs: null`; otherwise they are in the rows. Whole numbers that
are all within 0 to 255 are stacked as uint8, the texts of a dictionary as they are. Observations that do not stack
(ragged ones, texts by themselves) stay in the rows.
"""

from __future__ import annotations

import io
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.messages.episode import PolicyFailure, ResourceLimits
from evopolicy_common.messages.gateway import EpisodeFeedback, FeedbackDetail
from evopolicy_common.records.episodes import rendered, trajectory
from evopolicy_common.records.episodes.npz import read_arrays
from evopolicy_common.records.episodes.rendered import (
    LEFT_OUT,
    MAX_OBSERVATIONS_BYTES,
    OBSERVATIONS,
    ROWS,
    SINGLE,
)
from evopolicy_gateway.submits.formatting import cut_text, failure_line

_NO_MESSAGE = "messages of a policy are left out at this run's level of feedback"

LEFT_OUT_FIRST = ("video.mp4", "observations.npz", "observations.npy", "trajectory.jsonl")
"""Files that are left out, in this order, until the episode's files fit into its share."""
MUCH_BYTES = 16 << 20
"""Files of larger episodes are made one after another."""
MAX_UNPACKED_BYTES = 512 << 20
"""Limit of an episode that its worker did not render, unpacked, bytes."""


def takes_much(packed: bytes) -> bool:
    """Whether making the files of an episode may need many times the memory that the episode takes packed."""
    try:
        return rendered.Container(packed).size > MUCH_BYTES
    except ProtocolError:
        return True


def episode_share(limits: ResourceLimits, episode_budget: int) -> int:
    """Maximum size of one episode's files, bytes."""
    return limits.feedback_bytes // max(1, episode_budget)


def shows_texts(detail: FeedbackDetail, storage: ObsStorage) -> bool:
    """Whether the level shows everything that a policy observes, and so the policy's own texts too."""
    return detail == "pictures" or (detail == "trajectories" and storage == "inline")


def within_share(files: dict[str, bytes], share: int) -> dict[str, bytes]:
    """Returns the files that fit into `share` bytes; `left_out.txt` names the others."""
    size = sum(map(len, files.values()))
    left_out: list[str] = []
    kept = dict(files)
    for name in LEFT_OUT_FIRST:
        if size > share and name in kept:
            left_out.append(f"{name}: {len(kept[name]):,} bytes\n")
            size -= len(kept.pop(name))
    if left_out:
        text = f"Left out, as an episode's files may take {share:,} bytes in this run:\n{''.join(left_out)}"
        kept[LEFT_OUT] = kept.get(LEFT_OUT, b"") + text.encode()
    return kept


def episode_files(
    episode: EpisodeFeedback,
    packed: bytes,
    video: bytes | None,
    storage: ObsStorage,
    *,
    at: float,
    share: int,
    detail: FeedbackDetail = "pictures",
    published: bool = False,
) -> dict[str, bytes]:
    """Returns the files of `episodes/ep_XXX/`, at most `share` bytes without the policy's printed output.

    At the level `scores` these are only the lines of `error.txt`, without messages; `packed` is not read then.

    `packed`: a rendered episode or a trajectory. `at`: Unix time for `error.txt`,
    seconds. `published`: observations are where the published software has them. Raises ProtocolError when `packed` is
    neither, or has another length or return than declared.
    """
    texts = _text_files(episode, at, whole=shows_texts(detail, storage))
    if detail == "scores":
        return texts
    if rendered.is_rendered(packed):
        files = rendered.checked_files(packed, episode.length, episode.episode_return)
    else:
        files = rendered.files_of(trajectory.decode(packed, MAX_UNPACKED_BYTES), storage)
    if published:
        files = as_published(files)
    if detail == "trajectories":
        files.pop(rendered.OBSERVATIONS, None)
        files.pop("observations.npy", None)
    elif video is not None:
        files["video.mp4"] = video
    return within_share(files, share) | texts


def set_aside_files(episode: EpisodeFeedback, why: str, *, at: float, texts: bool = True) -> dict[str, bytes]:
    """The files of an episode without its trajectory, and why. `texts`: with the policy's own texts."""
    files = _text_files(episode, at, whole=texts)
    failure = PolicyFailure(
        category="feedback_error",  # type: ignore[arg-type]  # an infrastructure failure, not the policy's
        message=f"{why}; the episode's return counts",
        step_index=None,
    )
    files["error.txt"] = files.get("error.txt", b"") + failure_line(failure, at)
    return files


def _text_files(episode: EpisodeFeedback, at: float, *, whole: bool) -> dict[str, bytes]:
    files = {"stdout.txt": cut_text(episode.stdout), "stderr.txt": cut_text(episode.stderr)} if whole else {}
    if (failure := episode.failure) is not None:
        if not whole:
            failure = msgspec.structs.replace(failure, message=_NO_MESSAGE, traceback="")
        files["error.txt"] = failure_line(failure, at)
    return files


MOST_INLINE_BYTES = 4096
_rows = msgspec.json.Decoder(dict[str, msgspec.Raw])


def as_published(files: dict[str, bytes]) -> dict[str, bytes]:
    """An episode's files with its observations where the published software has them. ValueError for a damaged file."""
    rows = [_rows.decode(line) for line in files[ROWS].splitlines()]
    beside = files.get(OBSERVATIONS)
    if beside is None:
        columns: dict[str, Any] = _columns([msgspec.json.decode(row["obs"]) for row in rows])
    else:
        columns = read_arrays(beside, MAX_OBSERVATIONS_BYTES)
    if not rows or not columns:
        return files
    columns = {name: _small(column) for name, column in columns.items()}
    single = columns[SINGLE] if list(columns) == [SINGLE] else None
    kept = {name: data for name, data in files.items() if name not in (ROWS, OBSERVATIONS)}
    if sum(column.nbytes for column in columns.values()) > MOST_INLINE_BYTES:
        file = io.BytesIO()
        if single is not None:
            np.save(file, single)
        else:
            np.savez_compressed(file, **columns)
        kept[OBSERVATIONS if single is None else "observations.npy"] = file.getvalue()
        shown = [msgspec.Raw(b"null")] * len(rows)
    elif beside is None:
        shown = [row["obs"] for row in rows]
    else:
        values = {name: column.tolist() for name, column in columns.items()}
        steps = [{name: values[name][t] for name in values} for t in range(len(rows))]
        shown = [msgspec.Raw(msgspec.json.encode(step if single is None else step[SINGLE])) for step in steps]
    kept[ROWS] = b"".join(
        msgspec.json.encode({**row, "obs": obs}) + b"\n" for row, obs in zip(rows, shown, strict=True)
    )
    return kept


def _columns(obs: list[Any]) -> dict[str, np.ndarray[Any, Any]]:
    """The stacked observations by name; empty if they do not stack."""
    if not obs:
        return {}
    parts, kinds = {SINGLE: obs}, "biuf"
    if isinstance(obs[0], dict):
        kinds += "U"
        parts = {name: [each[name] for each in obs] for name in obs[0]}
    try:
        columns = {name: np.array(part) for name, part in parts.items()}
    except ValueError:
        return {}
    return columns if all(column.dtype.kind in kinds for column in columns.values()) else {}


def _small(column: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if column.dtype.kind in "iu" and column.size and column.min() >= 0 and column.max() <= 255:
        return column.astype(np.uint8)
    return column
