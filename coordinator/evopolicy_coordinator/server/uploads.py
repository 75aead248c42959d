"""Which bundles a run's gateway has itself brought: only these may it submit.

The blobs of all runs lie in one folder, by digest. A digest is no secret (reports print those of bundles), and whether a
blob is there tells of others' runs and of hidden recordings. So a gateway's upload counts only when it has sent every byte
in this coordinator's lifetime, and is not told what was here before. What is forgotten is asked for and sent again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

MAX_RUNS = 10_000
"""The longest unused are forgotten beyond that; a run has to be open to be noted, so no gateway can crowd out others."""
MAX_OF_A_RUN = 64


class Uploads:
    """For several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._runs: OrderedDict[str, OrderedDict[str, None]] = OrderedDict()

    def note(self, run: str, digest: str) -> None:
        """The run's gateway has sent all of the blob."""
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
