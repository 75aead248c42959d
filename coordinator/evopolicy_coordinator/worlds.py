"""Which rules the worlds of an epoch have: candidates from its secret, and the journal of those that were
tried.

Rules that this module owns:
- The candidates of an environment are numbered from 0. The key of a candidate is its environment's root,
  HMAC-SHA256(secret, worlds | environment) cut to 128 bits, a hyphen, and its number. So the key of one
  case shows its number and all other candidates. It is committed to when a run is opened, and revealed with
  the epoch.
- A candidate is accepted if the canonical policy loses at least half of its distance from random, and the
  ceiling reaches at least 80 % of that distance. Candidates are tried in the order of their
  numbers. World n of the environment has the n-th accepted one.
- Without entries of the epoch and environment in the journal, world n has candidate n - 1, accepted or not.
- The journal has neither root nor rules.
"""

from __future__ import annotations

import hmac
from pathlib import Path

import msgspec

from evopolicy_common.catalogue.worlds import CANDIDATES, ids, unchanged
from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.journal import digest, epoch_of

JOURNAL = "worlds.jsonl"
"""Name of the journal in a state folder."""
CASES, VARIANTS = 8, 8
"""Cases of each evaluation, and variants of the policy in a search."""
LOSS, REACH = 0.5, 0.8
"""Of the distance from random to the canonical policy."""


class Base(msgspec.Struct, frozen=True, kw_only=True, tag="environment", tag_field="kind"):
    """An environment whose candidates are tried. All scores are mean returns over the same cases."""

    epoch: str
    env: str
    policy: str
    """SHA-256 of the canonical policy's bundle; empty: none is known, and no candidate is tried."""
    random: float | None = None
    canonical: float | None = None
    cases: int = CASES


class Candidate(msgspec.Struct, frozen=True, kw_only=True, tag="candidate", tag_field="kind"):
    epoch: str
    env: str
    number: int
    canonical: float
    """Score of the canonical policy in this world."""
    ceiling: float | None
    """Score of the best of the transformed policy and its variants; None: not played, as the policy lost
    too little."""
    variants: int
    """Policies played for the ceiling, the transformed one included."""
    accepted: bool


WorldEntry = Base | Candidate
_entries: msgspec.json.Decoder[WorldEntry] = msgspec.json.Decoder(WorldEntry)


def loses(base: Base, canonical: float) -> bool:
    """Whether the canonical policy loses enough in a world."""
    assert base.random is not None
    assert base.canonical is not None
    return base.canonical > base.random and base.canonical - canonical >= LOSS * (
        base.canonical - base.random
    )


def reaches(base: Base, ceiling: float) -> bool:
    """Whether enough can be earned in a world."""
    assert base.random is not None
    assert base.canonical is not None
    return ceiling - base.random >= REACH * (base.canonical - base.random)


def key_of(secret: bytes, env: str, number: int) -> str:
    """The key of a candidate of an environment, or of one of its worlds."""
    root = hmac.digest(secret, f"worlds|{unchanged(env)}".encode(), "sha256").hex()[:32]
    return f"{root}-{number}"


def number_of(env: str, secret: bytes, journal: Path | None) -> tuple[int, str]:
    """The candidate that a world of this epoch has, and the digest (SHA-256, hex) of the trials that chose it; empty
    without any. Raises ConfigError if too few were accepted, or the trials are not those of `accept-worlds`."""
    place = ids(unchanged(env)).index(env)
    tried = [] if journal is None else of_environment(read_journal(journal), epoch_of(secret), unchanged(env))
    if not tried:
        return place, ""
    candidates = [each for each in tried if isinstance(each, Candidate)]
    if [each.number for each in candidates] != list(range(min(len(candidates), CANDIDATES))):
        raise ConfigError(
            f"{journal}: the candidates of {unchanged(env)} are not 0 to {CANDIDATES - 1} in order, as"
            " `evopolicy-coordinator accept-worlds` tries them: restore the journal from a backup"
        )
    accepted = [each.number for each in candidates if each.accepted]
    if place >= len(accepted):
        raise ConfigError(
            f"{env} has no accepted rules in this epoch: {len(tried) - 1} candidates were tried and"
            f" {len(accepted)} accepted; repeat `evopolicy-coordinator accept-worlds` if it was interrupted, or"
            " leave this world out"
        )
    return accepted[place], digest(b"".join(msgspec.json.encode(each) + b"\n" for each in tried))


def of_environment(entries: list[WorldEntry], epoch: str, env: str) -> list[WorldEntry]:
    return [each for each in entries if each.epoch == epoch and each.env == env]


def read_journal(journal: Path) -> list[WorldEntry]:
    """All entries; none where there is no journal. Raises ConfigError for a damaged one."""
    try:
        return [_entries.decode(line) for line in journal.read_bytes().splitlines()]
    except FileNotFoundError:
        return []
    except (*DECODE_ERRORS, ValueError) as error:
        raise ConfigError(f"{journal} is no journal of worlds: {error}; restore it from a backup") from error


def append(journal: Path, entry: WorldEntry) -> None:
    """Adds an entry, durably."""
    lines = [msgspec.json.encode(each) + b"\n" for each in [*read_journal(journal), entry]]
    write_atomically(journal, b"".join(lines), mode=0o600)
