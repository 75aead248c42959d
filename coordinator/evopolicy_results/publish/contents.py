"""The content of a file of published results, and its paths. Pure.

    manifest.json              digests of everything below; the signature covers it
    signature.json             key and signature of the manifest's SHA-256
    journal.jsonl              all entries of the coordinator's journal, a line each, as they were hashed
    removed.json               what was taken out before publication
    card.json, card.md         the evaluation card
    croissant.json             what the files hold, for catalogues of data sets
    runs/0000/digests.json     digests of the files beside it: one run can be checked without the others
    runs/0000/run.json         the run's record
    runs/0000/opening.json, salt, result.json      what the journal's entries hold the hashes of
    runs/0000/episodes.json    the return of every episode that counts
    runs/0000/actions/GROUP    the recorded actions and rewards of a group's episodes
    runs/0000/checkpoints/003  the policy of a submit, as its bundle
    runs/0000/logs/agent.jsonl the agent's log, scrubbed, where its publisher chose to

Digests are SHA-256 (hex). JSON is as `document` makes it: the same content gives the same bytes.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_common.messages.bounds import Int, Many, Number, Word
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import RANDOM
from evopolicy_common.messages.operator import RunResult
from evopolicy_common.records import journal

FORMAT = "evopolicy results"
VERSION = 1
MANIFEST, SIGNATURE, JOURNAL, REMOVED = "manifest.json", "signature.json", "journal.jsonl", "removed.json"
CARD, CARD_TEXT, CROISSANT = "card.json", "card.md", "croissant.json"
DESCRIPTIONS = (CARD, CARD_TEXT, CROISSANT)
"""Files that follow from the others."""
DIGESTS, RUN, OPENING, RESULT, EPISODES = (
    f"{name}.json" for name in ("digests", "run", "opening", "result", "episodes")
)
SALT = "salt"
LOG = "logs/agent.jsonl"
"""Of a run, where its publisher chose to: the agent's log. The journal does not fix it."""
MAX_RUNS = 4096
MAX_DOCUMENT_BYTES = 64 << 20
MAX_RECORDING_BYTES = 1 << 30
"""Of a group's recordings together, packed."""
MAX_EPISODE_BYTES = 256 << 20
"""Of one recording, unpacked."""


digest = journal.digest
"""SHA-256 (hex) of bytes."""


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """The root of the tree of digests."""

    format: Word
    version: Int
    canary: Word
    software: Word
    journal_entries: Int
    journal_head: Word
    files: dict[str, str]
    """Of the files at the top, but manifest and signature, and of each run's `digests.json`."""


class Signature(msgspec.Struct, frozen=True, kw_only=True):
    """Ed25519, hexadecimal."""

    key: Word
    signature: Word


class PublishedEpisode(msgspec.Struct, frozen=True, kw_only=True):
    index: Int
    """Position in its group's list."""
    episode_return: Number
    length: Int
    failure: Word = ""
    """Category of the policy's failure; empty for none."""


class EpisodeGroup(msgspec.Struct, frozen=True, kw_only=True):
    """The episodes of one list of cases."""

    split: Split
    submit_index: Int
    """`RANDOM` for the random reference."""
    episodes: Many[PublishedEpisode]

    @property
    def name(self) -> str:
        return group_name(self.split, self.submit_index)

    @property
    def part(self) -> str:
        """The part of the run that it belongs to, in words."""
        if self.submit_index == RANDOM:
            return "random"
        return "held-out" if self.split == "heldout" else self.split


class Removed(msgspec.Struct, frozen=True, kw_only=True):
    what: str
    """A field of a file, or a file."""
    why: str


def group_name(split: str, submit_index: int) -> str:
    """A group's name in paths and findings."""
    return f"{split}-random" if submit_index == RANDOM else f"{split}-{submit_index:03d}"


def wanted_groups(result: RunResult) -> list[tuple[Split, int, int]]:
    """The groups whose returns a result rests on: split, submit index, number of episodes (-1: all of the split)."""
    groups: list[tuple[Split, int, int]] = []
    ok = [submit for submit in result.submits if submit.status == "ok"]
    groups += [("train", each.submit_index, len(each.env_instances)) for each in ok]
    groups += [("validation", each.submit_index, -1) for each in ok if each.val_mean is not None]
    if result.heldout_returns and result.best_submit_index is not None:
        groups.append(("heldout", result.best_submit_index, len(result.heldout_returns)))
    if result.random_heldout_returns:
        groups.append(("heldout", RANDOM, len(result.random_heldout_returns)))
    return groups


def checkpoint_path(submit_index: int) -> str:
    """Below a run's folder."""
    return f"checkpoints/{submit_index:03d}"


def document(content: object) -> bytes:
    """JSON with sorted keys: equal contents give equal bytes."""
    return msgspec.json.encode(content, order="sorted") + b"\n"


def journal_lines(entries: Iterable[bytes]) -> bytes:
    return b"".join(entry + b"\n" for entry in entries)


def journal_entries(data: bytes) -> list[bytes]:
    """The entries in `journal_lines`; ProtocolError where the last line has no end."""
    if data and not data.endswith(b"\n"):
        raise ProtocolError("the last line is cut off")
    return data.split(b"\n")[:-1]


def pack_recordings(recordings: list[bytes | None]) -> bytes:
    """The recordings of a group, by index; None for one that is not stored any more."""
    return msgspec.msgpack.encode(recordings)


_recordings = msgspec.msgpack.Decoder(list[bytes | None])


def unpack_recordings(data: bytes) -> list[bytes | None]:
    """ProtocolError for bytes that `pack_recordings` did not make."""
    with raised_as(ProtocolError, "not a group's recordings", *DECODE_ERRORS):
        return _recordings.decode(data)


class Listed(msgspec.Struct, frozen=True, kw_only=True):
    """A run that was opened for one of the published entries, or from which a published run starts."""

    run: str
    entry: str
    env: str
    exp_id: str
    repeat: int
    attempt: int
    state: str
    """`published`, a status of `run.json`, `not finished`, or `replayed` for a replay."""
    replaced_by: str = ""
    """The run that was opened later in its place; empty for none."""


def listing(entries: Iterable[journal.EpochEntry], published: Iterable[str]) -> tuple[Listed, ...]:
    """Every run in the journal of the `published` runs' entries, and the runs from which the published ones start, in
    the order in which they were opened."""
    chosen, entries = set(published), list(entries)
    opened = [each for each in entries if isinstance(each, journal.Opened)]
    line = set(chosen)
    for each in reversed(opened):  # a run starts from one that was opened before
        if each.run in line and each.start is not None:
            line.add(each.start.run)
    status = {each.run: each.status for each in entries if isinstance(each, journal.Ended)}
    names = {each.entry for each in opened if each.run in chosen}
    place = operator.attrgetter("exp_id", "entry", "env", "repeat")
    last = {place(each): each.run for each in opened if not each.replay_of}

    def listed(each: journal.Opened) -> Listed:
        state = "replayed" if each.replay_of else status.get(each.run, "not finished")
        later = each.run if each.replay_of else last[place(each)]
        return Listed(
            run=each.run,
            entry=each.entry,
            env=each.env,
            exp_id=each.exp_id,
            repeat=each.repeat,
            attempt=each.attempt,
            state="published" if each.run in chosen else state,
            replaced_by="" if later == each.run else later,
        )

    return tuple(listed(each) for each in opened if each.entry in names or each.run in line)


def completeness(listed: Sequence[Listed]) -> str:
    """How many of the runs that were opened are left out, in words."""
    omitted = [each.state for each in listed if each.state != "published"]
    if not omitted:
        return f"all {len(listed)} runs that the journal has of these entries and their starts are here"
    states = ", ".join(f"{omitted.count(state)} {state}" for state in sorted(set(omitted)))
    return (
        f"{len(omitted)} of {len(listed)} runs of these entries and their starts are left out ({states}): these runs"
        " were selected"
    )


SIGNED_MANIFEST = b"evopolicy manifest 1\0"
"""Prefix of the signed bytes."""


def signed_by(key: str, signature: str, digest: str) -> bool:
    """Whether the owner of the public `key` signed the `digest`; False for anything malformed, and for a key in another
    spelling, which would be another signer."""
    try:
        if bytes.fromhex(key).hex() != key:
            return False
        public = Ed25519PublicKey.from_public_bytes(bytes.fromhex(key))
        public.verify(bytes.fromhex(signature), SIGNED_MANIFEST + bytes.fromhex(digest))
    except (InvalidSignature, ValueError):
        return False
    return True
