"""The coordinator's journal: its commitment to each opened run, and the end of each run. Pure.

Rules that this module owns:
- A journal is an append-only list of entries, each the bytes of a JSON object.
- The hash of a journal, its *head*, starts with that of the empty journal (`EMPTY_HEAD`) and is updated by every entry:
  head(n) = SHA-256("evopolicy journal 1" NUL | head(n - 1) | SHA-256(entry n)).
- A commitment is SHA-256("evopolicy commitment 1" NUL | salt | document). The salt is 32 random bytes, so that
  documents cannot be guessed; the document (`Opening`) holds all three splits and all settings of a run.
- The entry that ends a run holds the SHA-256 of its result (`Result`).

Documents and entries are stored and published as the bytes that were hashed, and never encoded again: fields added by a
later version do not change stored data.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.bounds import Int, Many, Named, Number, Plain, Word
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.gateway import SubmitStatus
from evopolicy_common.messages.operator import RunFinished
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
    """SHA-256 (hex) of its `Result`."""
    at: Number


class Revealed(msgspec.Struct, frozen=True, kw_only=True, tag="revealed", tag_field="kind"):
    """Runs of an epoch were published: its cases are no longer secret."""

    epoch: Word
    runs: Many[Word]
    at: Number


Entry = Opened | Ended | Revealed


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


class SubmitResult(msgspec.Struct, frozen=True, kw_only=True):
    submit_index: Int
    status: SubmitStatus
    bundle: Word | None
    """SHA-256 (hex) of the policy's bundle."""
    env_instances: Many[Int]
    mean_return: Number | None
    val_mean: Number | None
    tree: Word = ""
    """Digest of the workspace; empty where it was not recorded."""


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """The numbers of a run's result."""

    run: Word
    status: Word
    best_submit_index: Int | None
    final_score: Number | None
    heldout_returns: Many[Number]
    random_heldout_returns: Many[Number]
    validation_ineligible: Many[Int]
    policy_failures: Named[Int]
    budget_used: Int
    infrastructure_retries: Int
    nondeterministic_results: Int
    submits: Many[SubmitResult]
    heldout_successes: Many[bool] = ()
    """Empty where the environment reports none."""
    record: Plain = {}
    """Further fields of `run.json` as they are published, by path."""


GATEWAY_SIDE = (
    "jail",
    "agent.harness",
    "agent.cli_version",
    "agent.model_string",
    "agent.retries",
    "agent.turns",
    "agent.tokens",
    "agent.model_use",
    "agent.resources",
    "agent.settings",
    "versions.agents_md_hash",
    "versions.rules_hash",
    "versions.initial_policy_hash",
)
"""Fields of `run.json` that a gateway's command knows, and sends as `record` when it closes the run."""


def result_of(finished: RunFinished) -> Result:
    """The part of a finished run that its last entry commits to."""
    same = {name: getattr(finished, name) for name in Result.__struct_fields__ if name not in _OWN}
    return Result(
        **same,
        validation_ineligible=tuple(sorted(finished.validation_ineligible)),
        submits=msgspec.convert(finished.submits, tuple[SubmitResult, ...], from_attributes=True),
        record=_record(finished),
    )


_OWN = ("validation_ineligible", "submits", "record")
"""Fields of `Result` that are not those of `RunFinished` of the same name."""


def _record(finished: RunFinished) -> dict[str, Any]:
    sent = finished.agent.get("record")
    fields = {name: sent[name] for name in GATEWAY_SIDE if name in sent} if isinstance(sent, dict) else {}
    fingerprint = finished.fingerprint
    hashes = {name: f"sha256:{digest}" for name, digest in finished.split_hashes.items()}
    for name, split in (("train", "train"), ("valid", "validation"), ("heldout", "heldout")):
        fields[f"versions.data_{name}_hash"] = hashes.get(f"{name}.json", hashes.get(split, ""))
    if finished.random_heldout_returns:
        fields["outcome.random_reference.seeded_by"] = "case"
    for name in ("queue", "rollout", "finalise"):
        fields[f"timing.{name}_s"] = round(float(finished.wall_s.get(name, 0.0)), 3)
    return fields | {
        "env_title": finished.env_title,
        "env_family": finished.env_family,
        "hidden_isolation": finished.hidden_isolation,
        "outcome.closed_reason": finished.closed_reason,
        "versions.env": finished.env_version,
        "versions.env_deterministic": finished.deterministic,
        "versions.fingerprint": {} if fingerprint is None else fingerprint.flat(),
        "versions.fingerprint_overrides": ["left out" for _ in finished.fingerprint_overrides],
        "versions.installations": list(finished.installations),
    }


def document(content: Entry | Opening | Result) -> bytes:
    """The bytes of a document or entry, as they are hashed and stored."""
    return msgspec.json.encode(content, order="sorted")


_entries: msgspec.json.Decoder[Entry] = msgspec.json.Decoder(Entry)


def read_entry(data: bytes) -> Entry:
    """Decodes an entry. Raises ProtocolError for bytes that this version does not know as an entry."""
    try:
        return _entries.decode(data)
    except (*DECODE_ERRORS, ValueError) as error:
        raise ProtocolError(f"not an entry of a journal: {error}") from error


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


def epochs(entries: Iterable[Entry]) -> tuple[Epoch, ...]:
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
