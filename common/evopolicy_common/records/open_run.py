"""Private files in the folder of an open run, which its gateway writes, and which the live view reads too.

Paths are relative to the run's folder.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import msgspec

from evopolicy_common.messages.gateway import Submit, SubmitAccepted
from evopolicy_common.records.run_record import RejectedSubmit

STATE = ".gateway"
"""The gateway's own folder, while the run is open."""
INTENDED = f"{STATE}/intended.json"
"""The request to open the run: `CreateRun`, with `run` once it is opened. A command that was killed in between repeats
it and gets the same run."""
LISTENER = f"{STATE}/door.json"
"""There for a remote agent."""
JOURNAL = f"{STATE}/journal.jsonl"
"""One `AnyLine` a line."""
BUNDLES = f"{STATE}/bundles"


def is_held(lock: Path) -> bool:
    """Whether a process holds a lock file, or may hold it as this user cannot ask; False without the file."""
    try:
        fd = os.open(lock, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False


class JournalLine(msgspec.Struct, frozen=True, kw_only=True, tag_field="op"):
    """A line of the journal, named as a message is. At most one submit is open: the line `SubmitAccepted` is of the one
    that was requested last."""


class SubmitRequested(JournalLine, frozen=True, kw_only=True, tag="requested"):
    """A submit that passed the checks; written before anything of it is sent."""

    submit: Submit
    """As it is sent, but for the run and its token."""
    client_key: str | None
    """The agent's `Idempotency-Key`."""
    body_digest: str
    """SHA-256 of the request's body, hex."""
    kept: str | None = None
    """As in `SystemSnapshot`."""


class Settled(JournalLine, frozen=True, kw_only=True, tag="settled"):
    """Its feedback is committed."""

    key: str
    status: str
    summary: str
    """The text of `summary.json`, byte for byte."""


class SubmitRefused(JournalLine, frozen=True, kw_only=True, tag="refused"):
    """The coordinator refused it, and nothing was charged; or the gateway failed twice on it, and it is not retried. It
    has no feedback."""

    key: str
    status: str
    message: str


class Rejected(JournalLine, frozen=True, kw_only=True, tag="rejected"):
    """A request with an invalid form or outside the bounds, refused here before the snapshot."""

    submit: RejectedSubmit


class Died(JournalLine, frozen=True, kw_only=True, tag="died"):
    """A gateway died while it worked on a submit, or on the feedback of some of its episodes."""

    key: str
    episodes: tuple[int, ...] = ()
    """Request indices of these episodes; empty: the submit as a whole."""


AnyLine = SubmitRequested | SubmitAccepted | Settled | SubmitRefused | Rejected | Died
line_decoder = msgspec.json.Decoder(AnyLine)
