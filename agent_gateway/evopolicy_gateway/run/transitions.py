"""Counts a run's train steps, and those with a repaired action, from the written feedback."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from evopolicy_common.processes.left_files import left_files
from evopolicy_common.regular_files import open_regular

MAX_READ_BYTES = 8 << 30
"""Larger feedback is not counted: an agent without a jail may leave sparse files of any size."""
_INVALID = b'"action_invalid":true'
"""As written by `json_text.rows_text`. Quotes within a text are escaped there, so no text contains these bytes."""


def count_transitions(feedback: Path) -> dict[str, int] | None:
    """Over all recorded train episodes: `steps`, and as `action_invalid` those whose action was outside the action
    space and was repaired. None when the feedback is too large or cannot be read."""
    counts = {"steps": 0, "action_invalid": 0}
    try:
        if not stat.S_ISDIR(os.lstat(feedback).st_mode):
            return None
        files = {
            path: size
            for path, size in left_files(feedback)
            if path.name == "trajectory.jsonl" and path.parent.parent.name == "episodes"
        }
        if sum(files.values()) > MAX_READ_BYTES:
            return None
        for path in files:
            # The file may have become a link or a pipe since it was listed.
            with open_regular(path) as file:
                for line in file:
                    counts["steps"] += line.endswith(b"\n")
                    counts["action_invalid"] += _INVALID in line
    except OSError:
        return None
    return counts
