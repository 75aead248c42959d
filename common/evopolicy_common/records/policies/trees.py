"""The workspace at each submit, as a tree: a list of its files, each by the digest of its content.

Rules that this module owns:
- A tree holds regular files of the workspace only, none by a link. `LEFT_OUT` belongs to the service or to an
  earlier run. The agent's home and logins lie elsewhere, and a file in which a key is found is left out.
- `system/` is that of the submit's bundle if there is one, so that the tree has exactly the submitted policy.
- Files, entries and bytes are bounded. A tree lists its omissions with the reasons. Recording fails no submit.
- `trees/submit_NNN.json` in the run's folder is the tree, and its SHA-256 the tree's digest. Each content is stored
  once.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import stat
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError, ConfigError, StorageError, raised_as
from evopolicy_common.records.blobs import BlobStore, digest_of, sync_filesystem, write_atomically
from evopolicy_common.records.policies.bundles import FOLDER, Bundle, BundleFile, check_path, walk, write_new
from evopolicy_common.records.secrets import Passed, positions
from evopolicy_common.regular_files import read_regular

TREES = "trees"
"""In a run's folder."""
HISTORY = "history"
"""In a workspace: the feedback of the run that this one starts from, read-only."""
LEFT_OUT = frozenset({"AGENTS.md", "feedback", HISTORY})
MAX_FILES = 5000
"""Of a tree. Twice as many files and folders are looked at."""
MAX_FILE_BYTES = 16 << 20
"""Of a file outside the bundle. The search for keys, which takes a second for 25 to 90 MB, holds up the gateway."""
MAX_TREE_BYTES = 128 << 20
MAX_STORED_BYTES = 1 << 30
"""All contents of one run; with more, changed files are omitted."""
MAX_LISTED = 100
"""Omissions with their reasons; further ones are counted."""
MAX_NAMED = 5
"""Paths of each kind in `changes`."""
_MAX_MANIFEST = 8 << 20
_SETTLED_NS = 2_000_000_000
"""A file that changed less than this before it was read is read again: the clock of file systems is coarse."""
_SUBMIT = re.compile(r"submit_[0-9]{1,9}")


class TreeFile(msgspec.Struct, frozen=True, array_like=True):
    path: str
    """Relative to the workspace, with forward slashes."""
    blob: str
    """SHA-256 of its content, hex."""
    size: int
    executable: bool = False


_Seen = tuple[tuple[int, int, int], TreeFile]
"""Inode, time of change and size of a file, and what it was."""


class Tree(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `trees/submit_NNN.json`."""

    files: tuple[TreeFile, ...]
    """By path."""
    omitted: dict[str, str] = {}
    """Path to reason, of the first `MAX_LISTED`."""
    n_omitted: int = 0


def name_of(folder: Path, index: int) -> str:
    """`submit_NNN`, as wide as the run's names are."""
    names = (path.stem for path in (folder / TREES).glob(f"submit_*{index}.json"))
    return next((name for name in names if submit_number(name) == index), f"submit_{index:03d}")


def changes(folder: Path, index: int) -> str:
    """In words, the files outside `system/` that changed since the submit before; may be empty."""
    try:
        trees = [read_tree(folder, name_of(folder, n))[0] for n in (index - 1, index) if n >= 0]
    except ConfigError:
        return ""
    old, new = ({file.path: file.blob for file in tree.files} for tree in [Tree(files=()), *trees][-2:])
    outside = [path for path in {**old, **new} if not path.startswith("system/")]
    parts = {
        "new": [path for path in outside if path not in old],
        "changed": [path for path in outside if path in old and path in new and new[path] != old[path]],
        "removed": [path for path in outside if path not in new],
    }
    words = [
        f"{what} {', '.join(paths[:MAX_NAMED])}{' …' * (len(paths) > MAX_NAMED)}"
        for what, paths in parts.items()
        if paths
    ]
    return "; ".join([*words, *([f"{trees[-1].n_omitted} not recorded"] if trees[-1].n_omitted else [])])


def submit_number(name: str) -> int | None:
    """The index in `submit_NNN`; None for another name."""
    return int(name.partition("_")[2]) if _SUBMIT.fullmatch(name) else None


def read_tree(folder: Path, submit: str) -> tuple[Tree, str]:
    """A tree of the run at `folder`, and its digest. Raises ConfigError for a missing or damaged one."""
    path = folder / TREES / f"{submit}.json"
    remedy = f"name a submit whose workspace is recorded in {path.parent}"
    with raised_as(ConfigError, path, OSError, BundleError, *DECODE_ERRORS, remedy=remedy):
        data = read_regular(path, _MAX_MANIFEST)
        tree = msgspec.json.decode(data, type=Tree)
        names = [file.path for file in tree.files]
        for name in names:
            check_path(name)
            if name.partition("/")[0] in LEFT_OUT:
                raise BundleError(f"{name!a} is not the agent's")
        if len(names) > MAX_FILES or len(set(names)) != len(names):
            raise BundleError(f"{len(names)} files, some of one name, or more than {MAX_FILES}")
        if sum(file.size for file in tree.files) > MAX_TREE_BYTES:
            raise BundleError(f"more than {MAX_TREE_BYTES:,} bytes")
    return tree, digest_of(data)


def restore(folder: Path, tree: Tree, workspace: Path) -> None:
    """Writes a tree's files below `workspace`. Raises StorageError for wrong content or a full disk."""
    blobs = BlobStore(folder / TREES)
    for file in tree.files:
        try:
            if blobs.size(file.blob) != file.size:
                raise ValueError(f"its content has not {file.size:,} bytes")
            data = blobs.read_blob(file.blob)
            write_new(workspace / file.path, data, 0o755 if file.executable else 0o644)
        except (OSError, ValueError, StorageError) as error:
            raise StorageError(f"cannot restore {file.path}: {error}") from error


def copy_history(
    feedback: Path, history: Path, last: int, to: Path, most: int = MAX_STORED_BYTES
) -> dict[str, str]:
    """Copies the feedback of submits up to index `last`, and the run's `history` as `earlier/`, to `to`,
    read-only. Returns the omissions, with reasons: links, special files, and files beyond `most` bytes."""
    omitted: dict[str, str] = {}
    names = sorted(os.listdir(feedback)) if feedback.is_dir() and not feedback.is_symlink() else []
    kept = [name for name in names if (number := submit_number(name)) is not None and number <= last]
    sources = [(f"{name}/", feedback / name) for name in kept]
    for prefix, source in [*sources, ("earlier/", history)]:
        for path, file in _walk(source, (), 100 * MAX_FILES):
            if isinstance(file, str):
                omitted[prefix + path] = file
                continue
            with file:
                data = file.read(most + 1)
            if len(data) > most:
                omitted[prefix + path] = "the history is too large"
                continue
            most -= len(data)
            write_new(to / prefix / path, data, 0o444)
    return omitted


class TreeRecorder:
    """Records the workspace of one run. Contents of an earlier process count."""

    def __init__(self, workspace: Path, folder: Path, *, started: bool = False) -> None:
        """`folder`: the run's `trees/`. `started`: from a submit, so that `history/` is the service's."""
        self._workspace, self._folder, self._started = workspace, folder, started
        self._blobs = BlobStore(folder)
        self._stored = sum(self._blobs.size(digest) for digest in self._blobs.digests())
        self._seen: dict[str, _Seen] = {}
        """By path, the files that need not be read again."""

    def record(self, submit: str, bundle: Bundle | None, passed: Passed | None) -> str:
        """Records the workspace now and returns the tree's digest. `bundle`: of this submit's `system/`. `passed`:
        values of the run, omitted as keys are. Raises OSError and StorageError where the disk refuses."""
        files: list[TreeFile] = []
        omitted: dict[str, str] = {}
        seen: dict[str, _Seen] = {}
        stored, free = self._stored, MAX_TREE_BYTES
        if not self._started and os.path.lexists(self._workspace / HISTORY):
            omitted[HISTORY] = "reserved for the history of a run that starts from a submit"
        n_omitted = len(omitted)
        whole = LEFT_OUT if bundle is None else LEFT_OUT | {"system"}
        submitted = ((f"system/{file.path}", file) for file in (() if bundle is None else bundle.files))
        for path, taken in itertools.chain(submitted, _walk(self._workspace, whole, 2 * MAX_FILES)):
            one: TreeFile | str
            if isinstance(taken, str):
                one = taken
            elif isinstance(taken, BundleFile):
                one = self._keep(path, taken.executable, taken.data, free, passed)
            else:
                with taken:
                    one = self._read(path, taken, free, passed, seen)
            if isinstance(one, TreeFile) and len(files) == MAX_FILES:
                one = f"more than {MAX_FILES} files"
            if isinstance(one, TreeFile):
                files.append(one)
                free -= one.size
                continue
            n_omitted += 1
            if len(omitted) < MAX_LISTED:
                omitted[path] = one
        self._seen = seen
        if self._stored != stored:
            sync_filesystem(self._folder)
        files.sort(key=lambda file: file.path)
        data = msgspec.json.encode(Tree(files=tuple(files), omitted=omitted, n_omitted=n_omitted))
        write_atomically(self._folder / f"{submit}.json", data)
        return digest_of(data)

    def _read(
        self, path: str, file: BinaryIO, free: int, passed: Passed | None, seen: dict[str, _Seen]
    ) -> TreeFile | str:
        info, now = os.fstat(file.fileno()), time.time_ns()
        state, known = (info.st_ino, info.st_ctime_ns, info.st_size), self._seen.get(path)
        if known is not None and known[0] == state and info.st_size <= free:
            one: TreeFile | str = known[1]
        elif info.st_size > min(free, MAX_FILE_BYTES):
            one = f"{info.st_size:,} bytes are too many"
        else:
            data = file.read(info.st_size + 1)
            one = self._keep(path, bool(info.st_mode & stat.S_IXUSR), data, free, passed)
        if isinstance(one, TreeFile) and info.st_ctime_ns + _SETTLED_NS < now:
            seen[path] = state, one
        return one

    def _keep(
        self, path: str, executable: bool, data: bytes, free: int, passed: Passed | None
    ) -> TreeFile | str:
        """The file, stored, or why it is omitted."""
        if len(data) > free:
            return f"{len(data):,} bytes are too many"
        digest = digest_of(data)
        if not self._blobs.has(digest):
            for _, what in positions(data, passed):
                return f"holds {what}"
            if self._stored + len(data) > MAX_STORED_BYTES:
                return f"the run's trees hold {MAX_STORED_BYTES:,} bytes"
            self._blobs.put(data, durable=False)
            self._stored += len(data)
        return TreeFile(path, digest, len(data), executable)


def _walk(root: Path, leave_out: Collection[str], most: int) -> Iterator[tuple[str, BinaryIO | str]]:
    """As `walk`; nothing where there is no such folder."""
    with contextlib.suppress(OSError):
        top = os.open(root, FOLDER)
        try:
            yield from walk(top, leave_out, most)
        finally:
            os.close(top)
