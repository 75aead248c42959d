"""The train, validation and held-out cases: read from files, or derived from the coordinator's secret.

Rules that this module owns:
- The three splits of an environment share no case (seed and options), and none repeats a case
  (`evopolicy_common.records.splits` finds the faults).
- Derived seeds are HMAC-SHA256(secret, suite | environment | split | index | draw), truncated to 31 bits, with
  further draws when a seed is already taken. Seeds are drawn index by index over all three splits, so a case does not
  change when any split becomes longer or shorter.
- `secret` states whether hidden cases are unpredictable: true for splits derived from a 256-bit secret, and for files
  that declare it; false for splits made from a public seed, and for all other files.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import itertools
import secrets
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.catalogue import folder_name
from evopolicy_common.catalogue.worlds import KEY, OPTION, unchanged
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import Case, Split
from evopolicy_common.messages.operator import FurtherCases
from evopolicy_common.records.blobs import fsync_directory, write_atomically
from evopolicy_common.records.journal import epoch_of
from evopolicy_common.records.splits import (
    FILE_STEMS,
    SEED_LIMIT,
    SPLITS,
    SplitFile,
    cases_hash,
    folder_of,
    overlaps,
    read_split_file,
)
from evopolicy_coordinator import worlds

SECRET_BYTES = 32
SECRET, UNJAILED_SECRET = "secret", "secret-unjailed"
"""Files of the state folder with the secrets for runs with jailed and with unjailed agents."""


class EnvironmentSplits(msgspec.Struct, frozen=True, kw_only=True):
    env: str
    train: tuple[Case, ...]
    validation: tuple[Case, ...]
    heldout: tuple[Case, ...]
    secret: bool
    """Whether the hidden cases cannot be guessed from public facts."""
    epoch: str = ""
    """Public name of the cases' origin: the secret, or the files."""
    files: dict[str, str] = {}
    """SHA-256 (hex) of the bytes of the files that the cases come from, by file name."""
    trials: str = ""
    """SHA-256 (hex) of the trials of candidates that chose a world's rules; empty without any."""

    def cases(self, split: Split) -> tuple[Case, ...]:
        """The cases of `split`, in order of their ids."""
        return {"train": self.train, "validation": self.validation, "heldout": self.heldout}[split]

    def hashes(self) -> dict[str, str]:
        """SHA-256 (hex) of each split's cases by split name, and of their files by file name."""
        return {split: cases_hash(self.cases(split)) for split in SPLITS} | self.files


def derive(
    secret: bytes, suite: str, env: str, counts: dict[Split, int], taken: Iterable[int] = ()
) -> dict[Split, tuple[Case, ...]]:
    """Derives `counts[split]` cases of each split, none with a seed in `taken`; deterministic in its arguments."""
    taken = set(taken)
    drawn: dict[Split, list[Case]] = {split: [] for split in SPLITS}
    for index in range(max(counts.values(), default=0)):
        for split in SPLITS:
            seed = _draw(secret, suite, env, split, index, taken)
            taken.add(seed)
            drawn[split].append(Case(seed=seed))
    return {split: tuple(drawn[split][: counts.get(split, 0)]) for split in SPLITS}


def in_world(env: str, key: str, cases: dict[Split, tuple[Case, ...]]) -> dict[Split, tuple[Case, ...]]:
    """The cases with the key of their world; of an environment that is no world, as they are."""
    if unchanged(env) == env:
        return cases
    options = {OPTION: key}
    return {
        split: tuple(Case(seed=each.seed, options=options) for each in some) for split, some in cases.items()
    }


def _draw(secret: bytes, suite: str, env: str, split: Split, index: int, taken: set[int]) -> int:
    names = (f"{suite}|{env}|{split}|{index}|{draw}".encode() for draw in itertools.count())
    digests = (hmac.digest(secret, name, "sha256") for name in names)
    seeds = (int.from_bytes(digest[:4], "big") % SEED_LIMIT for digest in digests)
    return next(seed for seed in seeds if seed not in taken)


def public_secret(seed: int) -> bytes:
    """The key for splits of a public seed: anyone who knows the number knows the cases."""
    return hashlib.sha256(f"evopolicy public split seed {seed}".encode()).digest()


def secret_of(state: Path, *, unjailed: bool = False) -> tuple[bytes, str]:
    """The 256-bit secret for new runs' splits, and a note when it differs from the one before.

    An agent without a full jail runs as the user who owns the state and can read everything there. So runs with
    `unjailed` agents have a secret of their own, and the other one is removed before any such agent starts. The next
    run with jailed agents gets a new one. Runs keep their cases in the database, so earlier runs can still be
    verified.
    """
    usual, own = state / SECRET, state / UNJAILED_SECRET
    if unjailed:
        data = load_or_create_secret(own)
        with contextlib.suppress(FileNotFoundError):
            usual.unlink()
            fsync_directory(state)
        return data, (
            "agents of this run have no full jail and could read the cluster's state: its cases are of its own, and"
            " later runs with jailed agents get new ones"
        )
    is_new = own.exists() and not usual.exists()
    return load_or_create_secret(usual), (
        "an agent without a full jail has run on this state: the cases are new from here on, and do not compare with"
        " those of earlier runs"
        if is_new
        else ""
    )


def renew_secrets(state: Path) -> str:
    """Replaces the secrets by a new one, for good, and returns the new epoch's public name. Runs keep their
    cases in the database, so unfinished ones continue, and finished ones can still be verified."""
    for name in (SECRET, UNJAILED_SECRET):
        (state / name).unlink(missing_ok=True)
    return epoch_of(load_or_create_secret(state / SECRET))


def load_or_create_secret(path: Path) -> bytes:
    """The 256 bits in the file, made on first use. Raises ConfigError if too short, or readable by others."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = secrets.token_bytes(SECRET_BYTES)
        write_atomically(path, data, mode=0o600)
        return data
    if len(data) != SECRET_BYTES:
        raise ConfigError(
            f"{path} holds {len(data)} bytes instead of {SECRET_BYTES}; restore it from a backup"
        )
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        raise ConfigError(f"{path} may be read by others (mode {mode:04o}); run: chmod 600 {path}")
    return data


def load(folder: Path) -> tuple[EnvironmentSplits | None, list[str]]:
    """Returns the splits in one environment's folder (None when unreadable) and descriptions of their faults."""
    faults: list[str] = []
    contents: dict[Split, SplitFile] = {}
    hashes: dict[str, str] = {}
    for split in SPLITS:
        name = f"{FILE_STEMS[split]}.json"
        try:
            contents[split], hashes[name] = read_split_file(folder / name)
        except ConfigError as error:
            faults.append(str(error))
    if len(contents) < len(SPLITS):
        return None, faults
    env, cases = contents["train"].env, {split: content.cases for split, content in contents.items()}
    for split, content in contents.items():
        faults += _file_faults(folder, split, content, env)
    secret = all(content.secret is True for content in contents.values())
    return EnvironmentSplits(
        env=env, secret=secret, epoch="", files=hashes, trials="", **cases
    ), faults + overlaps(cases)


def _file_faults(folder: Path, split: Split, content: SplitFile, env: str) -> list[str]:
    own = content.env
    in_place = folder.name == folder_name(own) or folder.as_posix().endswith(f"/{own}")
    faults = (
        (content.split not in (split, FILE_STEMS[split]), f"says it is split {content.split!r}"),
        (own != env, f"is of environment {own!r}, train.json of {env!r}"),
        (not in_place, f"is of environment {own!r}, which belongs in {folder_name(own)}/ or {own}/"),
        (not content.cases, "has no cases"),
    )
    return [f"{folder.name}/{FILE_STEMS[split]}.json {fault}" for applies, fault in faults if applies]


class SplitSource:
    """A coordinator's source of splits: a data folder, or its secret."""

    def __init__(self, *, data: Path | None, secret: bytes, journal: Path | None = None) -> None:
        """`data` None: derive all splits. `journal`: of worlds. Raises ConfigError when `data` is no
        folder."""
        if data is not None and not data.is_dir():
            raise ConfigError(f"--data {data} is not a folder")
        self._data = data
        self._secret = secret
        self._journal = journal

    @property
    def from_files(self) -> bool:
        """Whether splits are read from files; otherwise they are derived."""
        return self._data is not None

    def splits(self, suite: str, env: str, counts: dict[Split, int], own: str = "") -> EnvironmentSplits:
        """Returns the splits of `env`; derived ones have exactly `counts`, those from files are cut to `counts` where
        set.

        `counts` may leave out a split from files (all of the file's cases). `own` names a run with hidden cases of
        its own, which no other run has. Raises ConfigError when files are missing, invalid, or have fewer cases than
        requested, and when `own` is set but cases come from files.
        """
        if self._data is None:
            cases = derive(self._secret, suite, env, counts)
            if own:
                key = hmac.digest(self._secret, f"hidden cases of run {own}".encode(), "sha256")
                shared = {case.seed for members in cases.values() for case in members}
                cases = {**derive(key, suite, env, counts, shared), "train": cases["train"]}
            world, trials = self._key(env)
            cases = in_world(env, world, cases)
            epoch = epoch_of(self._secret)
            return EnvironmentSplits(env=env, secret=True, epoch=epoch, files={}, trials=trials, **cases)
        if own:
            raise ConfigError(
                "--set hidden_cases=per-run needs cases that are derived from the coordinator's secret; this one takes"
                f" them from {self._data}, so all runs share them"
            )
        folder = folder_of(self._data, env)
        splits, faults = load(folder)
        if splits is None or faults:
            more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
            raise ConfigError(
                f"splits of {env} in {folder} cannot be used: {faults[0]}{more}; see `evopolicy data check`"
            )
        known = {(case.options or {}).get(OPTION) for split in SPLITS for case in splits.cases(split)}
        if unchanged(env) != env and (len(known) > 1 or not KEY.fullmatch(str(*known))):
            raise ConfigError(
                f"splits of {env} in {folder} cannot be used: all cases of a world have the same key; give each the"
                " options"
                f' {{"{OPTION}": "32 hexadecimal digits"}}, as `evopolicy data make` does'
            )
        if splits.env != env:
            raise ConfigError(f"{folder} holds the splits of {splits.env!r}, not of {env!r}")
        for split, count in counts.items():
            if count > (n := len(splits.cases(split))):
                raise ConfigError(
                    f"{folder / FILE_STEMS[split]}.json has {n} cases, and {count} are requested; extend the file or"
                    " request fewer"
                )
        cut = {split: splits.cases(split)[: counts.get(split)] for split in SPLITS}
        epoch = f"files-{cases_hash((*splits.validation, *splits.heldout))[:16]}"
        return EnvironmentSplits(
            env=env, secret=splits.secret, epoch=epoch, files=splits.files, trials="", **cut
        )

    def further(self, suite: str, env: str, name: str, n: int, taken: Sequence[Case]) -> FurtherCases:
        """`n` further hidden cases, equal for equal `name`, without `taken`. Raises ConfigError with
        files."""
        if self._data is not None:
            raise ConfigError(
                f"this coordinator takes its cases from {self._data} and derives none: name a folder with further cases"
                " (--data)"
            )
        key = hmac.digest(self._secret, f"further hidden cases {name}".encode(), "sha256")
        cases = derive(key, suite, env, {"heldout": n}, (case.seed for case in taken))
        cases = in_world(env, self._key(env)[0], cases)
        return FurtherCases(cases=cases["heldout"], epoch=epoch_of(self._secret))

    def _key(self, env: str) -> tuple[str, str]:
        """The key of a world, and the digest of the trials that chose it; both empty for any other environment."""
        if unchanged(env) == env:
            return "", ""
        number, trials = worlds.number_of(env, self._secret, self._journal)
        return worlds.key_of(self._secret, env, number), trials
