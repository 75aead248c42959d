"""The feedback tree on disk: episodes are written to `submit_NNN.partial/`, which one rename turns into `submit_NNN/`.

- Everything in a folder is durable before the rename; `summary.json` is written last.
- A folder without `.partial` is complete and never changes.
- Whatever an agent may have put in the way is removed, never followed.
- A `.partial` folder need not be durable, because it is rewritten after a crash: one flush of the file system at the
  end covers all its files.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

from evopolicy_common.processes.scratch import give_back_rights, remove_tree
from evopolicy_common.records.blobs import fsync_directory, sync_filesystem
from evopolicy_gateway.run_folder.journal import write_all

SUMMARY = "summary.json"


class SubmitTree:
    """One submit's folder while it is written. Not thread-safe; every call may block on the disk and raise OSError.

    After an OSError, call `begin` and write everything again.
    """

    def __init__(self, feedback: Path, submit_id: str) -> None:
        self._feedback = feedback
        self._partial = feedback / f"{submit_id}.partial"
        self._episodes = str(self._partial / "episodes")
        self.final = feedback / submit_id

    def begin(self) -> None:
        """Creates an empty `.partial` folder, replacing an earlier one."""
        give_back_rights(self._feedback.parent)
        if self._feedback.is_symlink() or not self._feedback.is_dir():
            _remove(self._feedback)
            self._feedback.mkdir(parents=True)
        _remove(self._partial)
        (self._partial / "episodes").mkdir(parents=True)

    def put_episode(self, name: str, files: Mapping[str, bytes]) -> None:
        """Writes an episode's folder with its files; the folder appears complete."""
        # Texts, not `Path`: a run has thousands of episodes.
        hidden, shown = f"{self._episodes}/.{name}", f"{self._episodes}/{name}"
        try:
            os.mkdir(hidden)
        except FileExistsError:
            _remove(Path(hidden))
            os.mkdir(hidden)
        for file_name, data in files.items():
            _write(f"{hidden}/{file_name}", data)
        try:
            os.rename(hidden, shown)
        except OSError:
            # The name is taken: its entry is removed, never followed.
            _remove(Path(shown))
            os.rename(hidden, shown)

    def drop_episode(self, name: str) -> None:
        """Removes an episode's folder, if it exists."""
        _remove(self._partial / "episodes" / name)

    def commit(self, summary: bytes, errors: bytes | None) -> None:
        """Writes `errors.txt` (unless None), then `summary.json`, and renames the folder."""
        if errors is not None:
            _write(self._partial / "errors.txt", errors)
        _write(self._partial / SUMMARY, summary)
        sync_filesystem(self._partial)
        # Left by a gateway that died between the rename and its journal entry, or put there by the agent.
        _remove(self.final)
        self._partial.rename(self.final)
        fsync_directory(self._feedback)


def _write(path: Path | str, data: bytes) -> None:
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o444)
    try:
        write_all(fd, data)
    finally:
        os.close(fd)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        remove_tree(path)
        if path.exists():
            raise OSError(errno.ENOTEMPTY, "cannot be removed", str(path))
    else:
        path.unlink(missing_ok=True)
