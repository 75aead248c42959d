"""The persistent part of an agent's session, sufficient to resume after any process was killed.

It is written after every change, to a private file outside the workspace.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, StorageError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_gateway.relay.usage import Usage


class SessionState(msgspec.Struct, kw_only=True):
    session: str | None = None
    """The CLI's id of the session; None until the CLI has reported it."""
    cli_version: str | None = None
    turns: int = 0
    retries: int = 0
    """Turns started again after a failure."""
    reprompts: int = 0
    paused_s: float = 0.0
    requests_failed: int = 0
    """Number of retries by the CLI itself."""
    used: dict[str, Usage] = {}
    """Tokens by session id: replaced if the stream counts the session, added up if it counts the turn."""

    @property
    def usage(self) -> Usage:
        """Token use of the whole run."""
        return sum(self.used.values(), Usage())

    def add_usage(self, session: str, usage: Usage, *, cumulative: bool) -> None:
        """Records the usage of a finished turn."""
        if cumulative:
            # A failed turn may report no usage, which must not reset its session's count.
            if usage.total >= self.used.get(session, Usage()).total:
                self.used[session] = usage
        else:
            self.used[session] = self.used.get(session, Usage()) + usage


def load(path: Path | None) -> SessionState:
    """The state in a file; a new one if the file is missing or unreadable."""
    if path is None:
        return SessionState()
    try:
        return msgspec.json.decode(path.read_bytes(), type=SessionState)
    except (OSError, *DECODE_ERRORS):
        return SessionState()


def save(path: Path | None, state: SessionState) -> None:
    """Saves the state. If the disk refuses it is lost, and the agent continues."""
    if path is not None:
        with contextlib.suppress(StorageError):
            write_atomically(path, msgspec.json.encode(state), mode=0o600)
