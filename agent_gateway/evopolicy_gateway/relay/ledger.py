"""The relay's ledger: a file with one JSON line for each request that went to the provider, without its content."""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_gateway.relay.limits import Request, Used

_decoder = msgspec.json.Decoder(Request)


class Ledger:
    """Appends requests, unbuffered: a line that is written survives the end of any process."""

    def __init__(self, path: Path, declared: str | None) -> None:
        self.used = read(path, declared)
        self._declared = declared
        self._file = path.open("ab", buffering=0)
        if self._file.tell():
            self._file.write(b"\n")  # a kill may have left half a line

    def close(self) -> None:
        self._file.close()

    def write(self, request: Request) -> None:
        """Raises OSError when the disk refuses."""
        self.used.take(request, self._declared)
        self._file.write(msgspec.json.encode(request) + b"\n")


def read(path: Path, declared: str | None = None) -> Used:
    """The use of a ledger's requests; none where there is no ledger. Lines that cannot be read are skipped."""
    used = Used()
    with contextlib.suppress(OSError):
        for line in path.read_bytes().splitlines():
            with contextlib.suppress(*DECODE_ERRORS):
                used.take(_decoder.decode(line), declared)
    return used
