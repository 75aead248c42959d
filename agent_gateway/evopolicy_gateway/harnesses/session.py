"""What of an agent's session outlives its processes: enough to go on after anything was killed.

Written after every change, in a private file outside the workspace.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.records.blobs import write_atomically
from evopolicy_gateway.harnesses.usage import Usage


class SessionState(msgspec.Struct, kw_only=True):
    """One run's side of an agent."""

    session: str | None = None
    """The CLI's id of the session; None before it told one."""
    turns: int = 0
    """Turns that the agent ended as it should."""
    retries: int = 0
    """Turns that were begun again after a failure."""
    reprompts: int = 0
    paused_s: float = 0.0
    requests_failed: int = 0
    """Retries that the CLI made by itself."""
    used: dict[str, Usage] = {}
    """Tokens by session id: replaced where the stream counts the session, added to where it counts the turn."""

    @property
    def usage(self) -> Usage:
        """Of the whole run."""
        return sum(self.used.values(), Usage())

    def usage_without(self, session: str | None) -> Usage:
        """Of all sessions but this one."""
        return sum((usage for known, usage in self.used.items() if known != session), Usage())

    def take(self, session: str, usage: Usage, *, cumulative: bool) -> None:
        """Books what a turn used, once it is over."""
        if cumulative:
            # A turn that failed tells nothing; its session's count must not be lost by it.
            if usage.total >= self.used.get(session, Usage()).total:
                self.used[session] = usage
        else:
            self.used[session] = self.used.get(session, Usage()) + usage


def load(path: Path | None) -> SessionState:
    """The state in a file; a new one where there is none, or none that can be read."""
    if path is None:
        return SessionState()
    try:
        return msgspec.json.decode(path.read_bytes(), type=SessionState)
    except (OSError, *DECODE_ERRORS):
        return SessionState()


def save(path: Path | None, state: SessionState) -> None:
    """Keeps it; what the disk refuses is lost, the agent goes on."""
    if path is None:
        return
    try:
        write_atomically(path, msgspec.json.encode(state), mode=0o600)
    except OSError:
        return
