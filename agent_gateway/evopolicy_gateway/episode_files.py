"""One episode's folder in the feedback tree, as file names and bytes; pure."""

from __future__ import annotations

from evopolicy_common import trajectory
from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.messages.gateway import EpisodeFeedback
from evopolicy_gateway.formatting import cut_text, failure_line, trajectory_row
from evopolicy_gateway.storage import named_columns, npy_bytes, npz_bytes, storage_for


def episode_files(
    episode: EpisodeFeedback, packed: bytes, video: bytes | None, storage: ObsStorage, *, at: float
) -> dict[str, bytes]:
    """What `episodes/ep_XXX/` holds.

    `packed` is the trajectory's codec bytes; `at` the Unix time written into `error.txt`. ProtocolError when `packed`
    is no trajectory.
    """
    files = trajectory_files(packed, storage)
    if video is not None:
        files["video.mp4"] = video
    files["stdout.txt"] = cut_text(episode.stdout)
    files["stderr.txt"] = cut_text(episode.stderr)
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
    lines = [
        trajectory_row(
            row.t,
            row.obs if inline else None,
            row.action,
            row.reward,
            row.terminated,
            row.truncated,
            row.info,
        )
        for row in episode.rows()
    ]
    files = {"trajectory.jsonl": b"".join(lines)}
    if not inline and episode.obs is not None:
        named = named_columns(episode.obs)
        if storage == "npy" and list(named) == [""]:
            files["observations.npy"] = npy_bytes(named[""])
        else:
            files["observations.npz"] = npz_bytes(named)
    return files
