"""Bundles that each run's gateway has uploaded itself: it may submit only these.

The blobs of all runs share one folder, by digest. A digest is not secret (reports print those of bundles), and the
presence of a blob would reveal other runs and hidden recordings. So an upload counts only when the gateway has sent
every byte during this coordinator's lifetime, and the gateway is not told which bytes were stored before. A forgotten
upload is requested and sent again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

MAX_RUNS = 10_000
"""Beyond this number, the runs with the oldest uploads are forgotten. Only open runs are recorded, so no gateway can
crowd out others."""
MAX_OF_A_RUN = 64


class Uploads:
    """Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._runs: OrderedDict[str, OrderedDict[str, None]] = OrderedDict()

    def note(self, run: str, digest: str) -> None:
        """Records that the run's gateway has sent the whole blob."""
        with self._lock:
            digests = self._runs.setdefault(run, OrderedDict())
            self._runs.move_to_end(run)
            digests[digest] = None
            digests.move_to_end(digest)
            while len(digests) > MAX_OF_A_RUN:
                digests.popitem(last=False)
            while len(self._runs) > MAX_RUNS:
                self._runs.popitem(last=False)

    def has_sent(self, run: str, digest: str) -> bool:
        with self._lock:
            return digest in self._runs.get(run, ())
