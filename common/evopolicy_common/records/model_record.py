"""`logs/model/`: the record of a run's calls of its model, which the relay writes and `evopolicy replay` answers from.

- `calls.jsonl` has a line for each call (`ModelCall`), in the order in which the calls ended.
- `content.pack` has the requests and answers, each text once: frames of a digest (16 bytes), a length (4 bytes) and
  that many bytes, compressed by Zstandard. It is missing at the level `digests`.
- `stopped` tells why recording ended before the run; it is missing in a whole record.

Rules: both files only grow, up to `MAX_CALLS` and `MAX_PACK_BYTES`. A kill leaves at most one part of a line or frame,
which readers skip. Content is hostile: it is data of an agent and of a model's server, without the secrets
that logs leave out.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path
from typing import Any, Literal

import msgspec
import zstandard

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.regular_files import open_regular, read_regular

Level = Literal["off", "digests", "full"]
"""How much of the calls is kept: nothing, their digests, or all."""
FOLDER = "logs/model"
CALLS, PACK, STOPPED = "calls.jsonl", "content.pack", "stopped"
MAX_CALLS = 20_000
MAX_CALL_BYTES = 16 << 10
MAX_PACK_BYTES = 256 << 20
"""Limit of `content.pack`, compressed."""
MAX_CONTENT_BYTES = 32 << 20
"""Limit of one text, uncompressed."""
_KEY = 16
_HEAD = _KEY + 4


class ModelCall(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One call. Digests are the first 32 hex digits of a SHA-256."""

    n: int
    """Number of the call by its start, from 0."""
    api: str
    """Path of the API, such as `responses`."""
    method: str = "POST"
    digest: str
    """Of the canonical request: equal for requests that a replay takes for the same."""
    status: int
    """HTTP status; 0 where no answer came."""
    headers: dict[str, str] = {}
    """Of the answer, as far as they pass on to the agent."""
    answer: str = ""
    """Digest of the answer's bytes; empty where they were not read whole."""
    broken: bool = False
    """Whether the answer broke off."""
    request: str = ""
    """Digest of the request's content; empty at the level `digests`."""
    left_out: str = ""
    """Why the answer's content is not kept; empty where it is, or its level keeps none."""


_decoder = msgspec.json.Decoder(ModelCall)


def key_of(data: bytes) -> str:
    """The digest under which content is kept."""
    return hashlib.sha256(data).hexdigest()[: 2 * _KEY]


class StoredRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A canonical request. Elements of its lists are content of their own: requests repeat them."""

    plain: dict[str, Any]
    """The fields that are no lists."""
    lists: dict[str, list[str]]
    """Digests of the elements, by field."""


class Pack:
    """`content.pack`, opened to be read or, with `writes`, to be extended."""

    def __init__(self, folder: Path, *, writes: bool = False) -> None:
        """Raises ConfigError for a file that is none."""
        self._path = folder / PACK
        self._places: dict[str, tuple[int, int]] = {}
        with raised_as(ConfigError, self._path, OSError):
            self._file = self._path.open("a+b", buffering=0) if writes else open_regular(self._path)
            self.size = self._index()
            if writes:
                self._file.truncate(self.size)
        self._packer = zstandard.ZstdCompressor(level=3)

    def _index(self) -> int:
        at, end = 0, os.fstat(self._file.fileno()).st_size
        while at + _HEAD <= end:
            self._file.seek(at)
            head = self._file.read(_HEAD)
            length = int.from_bytes(head[_KEY:], "big")
            if at + _HEAD + length > end:
                break
            self._places[head[:_KEY].hex()] = (at + _HEAD, length)
            at += _HEAD + length
        return at

    def put(self, data: bytes) -> str:
        """Keeps `data` and returns its digest. Raises ValueError at the limits, OSError when the disk refuses."""
        key = key_of(data)
        if key in self._places:
            return key
        if len(data) > MAX_CONTENT_BYTES:
            raise ValueError(f"a text of {len(data):,} bytes is longer than {MAX_CONTENT_BYTES:,}")
        packed = self._packer.compress(data)
        if self.size + _HEAD + len(packed) > MAX_PACK_BYTES:
            raise ValueError(f"{PACK} has reached its limit of {MAX_PACK_BYTES:,} bytes")
        self._file.write(bytes.fromhex(key) + len(packed).to_bytes(4, "big") + packed)
        self._places[key] = (self.size + _HEAD, len(packed))
        self.size += _HEAD + len(packed)
        return key

    def get(self, key: str) -> bytes:
        """The content. Raises ConfigError when it is missing, damaged or too large."""
        try:
            at, length = self._places[key]
            self._file.seek(at)
            packed = self._file.read(length)
            if not 0 <= zstandard.frame_content_size(packed) <= MAX_CONTENT_BYTES:
                raise ValueError("too large")
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=MAX_CONTENT_BYTES)
            if key_of(data) != key:
                raise ValueError("bytes that do not match its digest")
        except KeyError as error:
            raise ConfigError(f"{self._path} has no content {key}") from error
        except (OSError, ValueError, zstandard.ZstdError) as error:
            raise ConfigError(f"{self._path}: content {key} cannot be read: {error}") from error
        return data

    def keys(self) -> list[str]:
        return list(self._places)

    def close(self) -> None:
        self._file.close()


def read_calls(folder: Path) -> list[ModelCall]:
    """The readable calls of a record, by their start. Raises ConfigError when there is no record."""
    path = folder / CALLS
    with raised_as(ConfigError, f"{path} cannot be read", OSError):
        lines = read_regular(path, MAX_CALLS * MAX_CALL_BYTES).splitlines()
    calls = []
    for line in lines:
        with contextlib.suppress(*DECODE_ERRORS):
            calls.append(_decoder.decode(line))
    return sorted(calls, key=lambda call: call.n)


def stopped(run: Path) -> str:
    """Why the record of a run directory ends before the run; empty where it does not."""
    try:
        return read_regular(run / FOLDER / STOPPED, MAX_CALL_BYTES).decode("utf-8", "replace").strip()
    except OSError:
        return ""


def request_of(pack: Pack, call: ModelCall) -> Any:
    """The recorded request's canonical JSON value. Raises ConfigError."""
    kept = msgspec.json.decode(pack.get(call.request), type=StoredRequest)
    lists = {name: [msgspec.json.decode(pack.get(key)) for key in keys] for name, keys in kept.lists.items()}
    return kept.plain | lists
