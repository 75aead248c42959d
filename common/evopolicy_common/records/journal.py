"""The coordinator's journal: its commitment to each opened run, and the end of each run. Pure.

Rules that this module owns:
- A journal is an append-only list of entries, each the bytes of a JSON object.
- The hash of a journal, its *head*, starts with that of the empty journal (`EMPTY_HEAD`) and is updated by every entry:
  head(n) = SHA-256("evopolicy journal 1" NUL | head(n - 1) | SHA-256(entry n)).
- A commitment is SHA-256("evopolicy commitment 1" NUL | salt | document). The salt is 32 random bytes, so that
  documents cannot be guessed; the document (`Opening`) holds all three splits and all settings of a run.
- The entry that ends a run holds the SHA-256 of its result (`RunResult`).

Documents and entries are stored and published as the bytes that were hashed, and never encoded again: fields added by a
later version do not change stored data.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_common.messages.bounds import Int, Many, Number, Word
from evopolicy_common.messages.environment import Case, Split
from evopolicy_common.messages.operator import RunResult
from evopolicy_common.messages.run_settings import RunSettings, Start

EMPTY_HEAD = hashlib.sha256(b"evopolicy journal 1").hexdigest()
SALT_BYTES = 32
_LINK = b"evopolicy journal 1\0"
_COMMITMENT = b"evopolicy commitment 1\0"
_EPOCH = b"evopolicy epoch 1\0"


class Opened(msgspec.Struct, frozen=True, kw_only=True, tag="opened", tag_field="kind"):
    """A run was opened. Written before its agent could start."""

    run: Word
    commitment: Word
    """SHA-256 (hex)."""
    epoch: Word
    entry: Word
    """Name of the agent; with `exp_id`, `env` and `repeat` it identifies the run's place in an experiment."""
    model: Word
    env: Word
    exp_id: Word
    repeat: Int
    attempt: Int
    at: Number
    """Unix time, seconds."""
    replay_of: Word = ""
    """As in the settings."""
    start: Start | None = None
    """As in the settings."""


class Ended(msgspec.Struct, frozen=True, kw_only=True, tag="ended", tag_field="kind"):
    """A run ended."""

    run: Word
    status: Word
    """As in `run.json`."""
    result: Word
    """SHA-256 (hex) of its `RunResult`."""
    at: Number


class Revealed(msgspec.Struct, frozen=True, kw_only=True, tag="revealed", tag_field="kind"):
    """Runs of an epoch were published: its cases are no longer secret."""

    epoch: Word
    runs: Many[Word]
    at: Number


EpochEntry = Opened | Ended | Revealed


class Opening(msgspec.Struct, frozen=True, kw_only=True):
    """The document of a commitment."""

    run: Word
    epoch: Word
    settings: RunSettings
    budget: Int
    min_episodes_per_submit: Int
    max_episodes_per_submit: Int
    max_steps: Int
    train: Many[Case]
    validation: Many[Case]
    heldout: Many[Case]
    cases_secret: bool
    """Whether the hidden cases are unpredictable."""
    allowed_imports: Many[Word]
    denied_imports: Many[Word]
    trials: Word = ""
    """SHA-256 (hex) of the trials of candidates that chose a world's rules (STATE/worlds.jsonl); empty without any."""
    policy_seeds: Word
    """SHA-256 (hex) of the secret from which the policies' random seeds derive."""

    def cases(self, split: Split) -> tuple[Case, ...]:
        return {"train": self.train, "validation": self.validation, "heldout": self.heldout}[split]


def document(content: EpochEntry | Opening | RunResult) -> bytes:
    """The bytes of a document or entry, as they are hashed and stored."""
    return msgspec.json.encode(content, order="sorted")


_entries: msgspec.json.Decoder[EpochEntry] = msgspec.json.Decoder(EpochEntry)


def read_entry(data: bytes) -> EpochEntry:
    """Decodes an entry. Raises ProtocolError for bytes that this version does not know as an entry."""
    with raised_as(ProtocolError, "not an entry of a journal", *DECODE_ERRORS, ValueError):
        return _entries.decode(data)


def commitment(salt: bytes, opening: bytes) -> str:
    """Commitment (SHA-256, hex) to a document with its salt."""
    return hashlib.sha256(_COMMITMENT + salt + opening).hexdigest()


def digest(data: bytes) -> str:
    """SHA-256 (hex)."""
    return hashlib.sha256(data).hexdigest()


def head_after(head: str, entry: bytes) -> str:
    """The journal's head (hex) after `entry` is appended to a journal with the head `head`."""
    return hashlib.sha256(_LINK + bytes.fromhex(head) + hashlib.sha256(entry).digest()).hexdigest()


def heads(entries: Iterable[bytes]) -> list[str]:
    return list(itertools.accumulate(entries, head_after, initial=EMPTY_HEAD))[1:]


def epoch_of(secret: bytes) -> str:
    """The public name of the epoch whose cases derive from `secret`, 256 random bits."""
    return hashlib.sha256(_EPOCH + secret).hexdigest()[:16]


class Epoch(msgspec.Struct, frozen=True, kw_only=True):
    epoch: str
    opened: int
    """Number of runs opened on its cases."""
    ended: int
    """Number of those that have ended."""
    began_at: float
    """Opening of the first run, Unix time, seconds."""
    revealed_at: float | None
    """Time at which its cases became public, Unix time, seconds; None while they are secret."""


def epochs(entries: Iterable[EpochEntry]) -> tuple[Epoch, ...]:
    """The epochs in a journal, in the order of their first runs."""
    runs: dict[str, str] = {}
    began: dict[str, float] = {}
    revealed: dict[str, float] = {}
    over: set[str] = set()
    for entry in entries:
        if isinstance(entry, Opened):
            runs[entry.run] = entry.epoch
            began.setdefault(entry.epoch, entry.at)
        elif isinstance(entry, Ended):
            over.add(entry.run)
        else:
            revealed.setdefault(entry.epoch, entry.at)
    return tuple(
        Epoch(
            epoch=epoch,
            opened=sum(of == epoch for of in runs.values()),
            ended=sum(of == epoch and run in over for run, of in runs.items()),
            began_at=at,
            revealed_at=revealed.get(epoch),
        )
        for epoch, at in began.items()
    )
