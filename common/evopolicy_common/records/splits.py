"""Files of train, validation and held-out cases: their names, content and hashes, and cases that occur twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import msgspec

from evopolicy_common.catalogue import folder_name
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import Case, Split
from evopolicy_common.regular_files import read_given

SPLITS: tuple[Split, ...] = ("train", "validation", "heldout")
FILE_STEMS: dict[Split, str] = {"train": "train", "validation": "valid", "heldout": "heldout"}
SEED_LIMIT = 2**31


class SplitFile(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Content of a `train.json`, `valid.json` or `heldout.json`."""

    env: str
    split: str
    """`train`, `valid` (or `validation`), `heldout`."""
    cases: tuple[Case, ...]
    secret: bool | None = None
    """False when made from a public seed; None when the file does not declare it."""


def folder_of(root: Path, env: str) -> Path:
    """Folder of the split files of `env` below `root`: `gym_acrobot/`, or as published `gym/acrobot/`."""
    return root / env if holds_splits(root / env) else root / folder_name(env)


def folders_below(root: Path) -> list[Path]:
    """Folders of both forms that hold split files, in order; only `root` if it is such a folder itself."""
    if holds_splits(root):
        return [root]
    return sorted(folder for pattern in ("*", "*/*") for folder in root.glob(pattern) if holds_splits(folder))


def holds_splits(folder: Path) -> bool:
    """Whether any split file is in `folder`."""
    return any((folder / f"{stem}.json").is_file() for stem in FILE_STEMS.values())


def cases_hash(cases: Iterable[Case]) -> str:
    """SHA-256 (hex) of the cases as canonical JSON: sorted keys, no spaces, `options` only if present."""
    plain = [
        {"seed": case.seed} | ({} if case.options is None else {"options": case.options}) for case in cases
    ]
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def read_split_file(path: Path) -> tuple[SplitFile, str]:
    """Returns the file's content and the SHA-256 (hex) of its bytes. Raises ConfigError with the file and its fault."""
    data = read_given(path, f"split file {path}")
    try:
        content = msgspec.json.decode(data, type=SplitFile)
        msgspec.msgpack.encode(content.cases)  # as they are stored: without integers of more than 64 bits
    except (msgspec.DecodeError, OverflowError, RecursionError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a split file: {error}") from error
    for number, case in enumerate(content.cases):
        if not 0 <= case.seed < SEED_LIMIT:
            raise ConfigError(f"{path}: case {number} has seed {case.seed}; seeds are 0 to {SEED_LIMIT - 1}")
    return content, hashlib.sha256(data).hexdigest()


def overlaps(cases: dict[Split, tuple[Case, ...]]) -> list[str]:
    """Describes each case that occurs more than once, in one split or in several."""
    repeats: list[str] = []
    places: dict[tuple[int, str], str] = {}
    for split, members in cases.items():
        for number, case in enumerate(members):
            place = f"{FILE_STEMS[split]} case {number}"
            # An environment cannot distinguish missing options from empty ones.
            key = (case.seed, json.dumps(case.options or None, sort_keys=True))
            if (first := places.setdefault(key, place)) != place:
                repeats.append(f"seed {case.seed} is {first} and {place}")
    return repeats
