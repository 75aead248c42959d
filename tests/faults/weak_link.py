"""A link between a worker and the coordinator that can be cut, stalled or slowed: bytes passed on between unix sockets."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

SLOW_S = 0.03
"""A slow link keeps each piece for so long."""


class WeakLink:
    """Listens on `path` and passes what comes on to `upstream`, as long as it is up."""

    def __init__(self, path: Path, upstream: Path) -> None:
        self._upstream = upstream
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._cut = False
        self._slow = False
        self._flows = threading.Event()
        self._flows.set()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    @contextlib.contextmanager
    def weak(self, how: Literal["cut", "stalled", "slow"]) -> Iterator[None]:
        """Cut: connections end and none begins. Stalled: nothing passes, and nobody is told. Slow: all comes late."""
        if how == "cut":
            self._cut = True
            self._end_all()
        elif how == "stalled":
            self._flows.clear()
        else:
            self._slow = True
        try:
            yield
        finally:
            self._cut = self._slow = False
            self._flows.set()

    def close(self) -> None:
        self._listener.close()
        self._flows.set()
        self._end_all()

    def _end_all(self) -> None:
        with self._lock:
            ends = list(self._open)
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                if self._cut:
                    raise ConnectionRefusedError
                far.connect(str(self._upstream))
            except OSError:
                near.close()
                far.close()
                continue
            with self._lock:
                self._open |= {near, far}
            for source, target in ((near, far), (far, near)):
                threading.Thread(target=self._pass, args=(source, target), daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self._flows.wait()
                if self._slow:
                    time.sleep(SLOW_S)
                target.sendall(data)
        # Either way down takes the other with it; the last one closes.
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        with self._lock:
            done = source not in self._open
            self._open -= {source, target}
        if done:
            source.close()
            target.close()
