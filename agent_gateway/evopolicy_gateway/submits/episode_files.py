"""One episode's folder in the feedback tree, as file names and bytes; pure."""

from __future__ import annotations

import json

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.messages.gateway import EpisodeFeedback
from evopolicy_common.records import trajectory
from evopolicy_common.records.summary import SCHEMA_VERSION, utc_text
from evopolicy_gateway.submits.formatting import cut_text, failure_line, trajectory_row
from evopolicy_gateway.submits.storage import named_columns, npy_bytes, npz_bytes, storage_for

FEEDBACK_ERROR = "feedback_error"
"""Category of the line in `error.txt` that tells of a fault of ours: the policy did not fail."""
MAX_TRAJECTORY_BYTES = 256 << 20
"""Of `trajectory.jsonl`. Actions alone cannot make so many: see `ResourceLimits.episode_action_bytes`."""


def episode_files(
    episode: EpisodeFeedback, packed: bytes, video: bytes | None, storage: ObsStorage, *, at: float
) -> dict[str, bytes]:
    """What `episodes/ep_XXX/` holds.

    `packed` is the trajectory's codec bytes; `at` the Unix time written into `error.txt`. ProtocolError when `packed`
    is no trajectory, or more than `trajectory.jsonl` may hold.
    """
    files = trajectory_files(packed, storage)
    if video is not None:
        files["video.mp4"] = video
    return files | _told_files(episode, at)


def set_aside_files(episode: EpisodeFeedback, why: str, *, at: float) -> dict[str, bytes]:
    """What the folder of an episode holds whose trajectory cannot be written: all but that, and the reason."""
    files = _told_files(episode, at)
    line = {
        "schema_version": SCHEMA_VERSION,
        "timestamp": utc_text(at),
        "category": FEEDBACK_ERROR,
        "message": f"{why}; the episode's return counts",
        "traceback": "",
        "step_index": None,
    }
    files["error.txt"] = (
        files.get("error.txt", b"") + json.dumps(line, separators=(",", ":")).encode() + b"\n"
    )
    return files


def _told_files(episode: EpisodeFeedback, at: float) -> dict[str, bytes]:
    files = {"stdout.txt": cut_text(episode.stdout), "stderr.txt": cut_text(episode.stderr)}
    if episode.failure is not None:
        files["error.txt"] = failure_line(episode.failure, at, with_step=True)
    return files


def trajectory_files(packed: bytes, storage: ObsStorage | None) -> dict[str, bytes]:
    """`trajectory.jsonl` and, where observations are stored outside it, `observations.npy` or `.npz`.

    `storage` None: as the observations themselves suggest.
    """
    episode = trajectory.decode(packed)
    if storage is None:
        storage = storage_for(episode.obs)
    inline = storage == "inline"
    lines: list[bytes] = []
    size = 0
    for row in episode.rows():
        obs = row.obs if inline else None
        lines.append(
            trajectory_row(row.t, obs, row.action, row.reward, row.terminated, row.truncated, row.info)
        )
        size += len(lines[-1])
        if size > MAX_TRAJECTORY_BYTES:
            raise ProtocolError(
                f"step {row.t} of {episode.n} brings trajectory.jsonl to {size:,} bytes;"
                f" {MAX_TRAJECTORY_BYTES:,} are the limit"
            )
    files = {"trajectory.jsonl": b"".join(lines)}
    if not inline and episode.obs is not None:
        named = named_columns(episode.obs)
        if storage == "npy" and list(named) == [""]:
            files["observations.npy"] = npy_bytes(named[""])
        else:
            files["observations.npz"] = npz_bytes(named)
    return files
