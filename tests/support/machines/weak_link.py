"""A link to a server that can be cut, stalled, slowed or garbled: bytes passed on between sockets, unix or TCP."""

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


How = Literal["cut", "stalled", "slow", "reordered"]
Address = Path | tuple[str, int]


class WeakLink:
    """Listens at `address` and passes what comes on to `upstream`, as long as it is up."""

    def __init__(self, address: Address, upstream: Address) -> None:
        """A path is a unix socket's; port 0 is any free one (see `port`)."""
        self._upstream = upstream
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._how: How | None = None
        self._flows = threading.Event()
        self._flows.set()
        self._listener = _socket(address)
        self._listener.bind(_name(address))
        self._listener.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    @contextlib.contextmanager
    def weak(self, how: How) -> Iterator[None]:
        """Cut: connections end and none begins. Stalled: nothing passes, and nobody is told. Slow: all comes late.
        Reordered: each piece arrives with its halves exchanged."""
        self._how = how
        if how == "cut":
            self._end_all()
        elif how == "stalled":
            self._flows.clear()
        try:
            yield
        finally:
            self._how = None
            self._flows.set()

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    def carried(self, data: bytes, *, outward: bool) -> None:
        """Sees each piece before it goes on. `outward`: from a client."""

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
            far = _socket(self._upstream)
            try:
                if self._how == "cut":
                    raise ConnectionRefusedError
                far.connect(_name(self._upstream))
            except OSError:
                near.close()
                far.close()
                continue
            with self._lock:
                self._open |= {near, far}
            for source, target in ((near, far), (far, near)):
                ends = (source, target, source is near)
                threading.Thread(target=self._pass, args=ends, daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket, outward: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self.carried(data, outward=outward)
                self._flows.wait()
                if self._how == "slow":
                    time.sleep(SLOW_S)
                if self._how == "reordered":
                    data = data[len(data) // 2 :] + data[: len(data) // 2]
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


def _socket(address: Address) -> socket.socket:
    return socket.socket(socket.AF_UNIX if isinstance(address, Path) else socket.AF_INET, socket.SOCK_STREAM)


def _name(address: Address) -> str | tuple[str, int]:
    return str(address) if isinstance(address, Path) else address
