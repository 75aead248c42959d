"""The bundles that each run's gateway uploads: it may submit only these.

The blobs of all runs share one folder, by digest. A digest is not secret (reports print those of bundles), and the
presence of a blob would reveal other runs and hidden recordings. So an upload counts only when the gateway has sent
every byte during this coordinator's lifetime, and the gateway is not told which bytes were stored before. A forgotten
upload is requested and sent again.

A gateway submits each bundle right after its upload. The number and size of the uploads that no submit names are
limited, as nobody is charged for them: otherwise an agent with its gateway's capability could fill the disk. They are
deleted after their run was closed, unless someone else has stored the same bytes, before or since. A coordinator that
is restarted leaves them to `evopolicy-coordinator gc`.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from evopolicy_common.errors import RefusedError
from evopolicy_common.records.blobs import FileState
from evopolicy_common.refusals import Refusal

MAX_RUNS = 10_000
"""Beyond this number, the runs with the oldest uploads are forgotten. Only open runs are recorded, so no gateway can
crowd out others."""
MAX_OF_A_RUN = 64
MAX_UNCLAIMED = 16
"""Uploads of a run, unfinished ones too, that no submit names."""
MAX_UNCLAIMED_BYTES = 256 << 20
"""Their size together."""


@dataclass(slots=True)
class _OfRun:
    sent: OrderedDict[str, None] = field(default_factory=OrderedDict)
    unclaimed: dict[str, int] = field(default_factory=dict)
    """Digest to announced size, from the first chunk on."""
    stored: dict[str, FileState] = field(default_factory=dict)
    """Of the blobs in `sent` that nobody had stored before."""


class Uploads:
    """Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._runs: OrderedDict[str, _OfRun] = OrderedDict()

    def begin(self, run: str, digest: str, size: int, submitted: Collection[str | None]) -> None:
        """Admits a chunk of a blob of `size` bytes. `submitted`: the bundles that the run's submits name.

        Raises RefusedError when the run has too many uploads, or too large ones, that no submit names.
        """
        with self._lock:
            unclaimed = self._of(run).unclaimed
            if size <= unclaimed.get(digest, -1) or digest in submitted:
                return
            for each in [each for each in unclaimed if each in submitted or each == digest]:
                del unclaimed[each]
            total = size + sum(unclaimed.values())
            if len(unclaimed) >= MAX_UNCLAIMED or total > MAX_UNCLAIMED_BYTES:
                raise RefusedError(
                    Refusal.TOO_LARGE,
                    f"run {run!r} would have {len(unclaimed) + 1} uploads of {total:,} bytes that no submit names;"
                    f" {MAX_UNCLAIMED} of {MAX_UNCLAIMED_BYTES:,} bytes are the limit: submit one of them",
                )
            unclaimed[digest] = size

    def note(self, run: str, digest: str, stored: FileState | None = None) -> None:
        """Records that the run's gateway has sent the whole blob. `stored`: its file, if nobody had stored it
        before."""
        with self._lock:
            uploads = self._of(run)
            uploads.sent[digest] = None
            uploads.sent.move_to_end(digest)
            if stored is not None:
                uploads.stored[digest] = stored
            while len(uploads.sent) > MAX_OF_A_RUN:
                uploads.stored.pop(uploads.sent.popitem(last=False)[0], None)

    def forget(self, over: Callable[[str], bool]) -> dict[str, dict[str, FileState]]:
        """Forgets the runs that are over. Returns the files that their uploads made, by run and digest."""
        with self._lock:
            return {run: self._runs.pop(run).stored for run in list(self._runs) if over(run)}

    def has_sent(self, run: str, digest: str) -> bool:
        with self._lock:
            return run in self._runs and digest in self._runs[run].sent

    def _of(self, run: str) -> _OfRun:
        uploads = self._runs.setdefault(run, _OfRun())
        self._runs.move_to_end(run)
        while len(self._runs) > MAX_RUNS:
            self._runs.popitem(last=False)
        return uploads
