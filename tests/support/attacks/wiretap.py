"""A relay on loopback that keeps every byte of the connections through it."""

from __future__ import annotations

from collections.abc import Callable

from machines.weak_link import WeakLink


class Wiretap(WeakLink):
    """Relays to `host:port`. `on_sent` sees what a client sent before it goes on."""

    def __init__(self, host: str, port: int, on_sent: Callable[[bytes], None] = lambda data: None) -> None:
        self._on_sent = on_sent
        self.sent = bytearray()
        """By clients."""
        self.heard = bytearray()
        """By clients."""
        super().__init__(("127.0.0.1", 0), (host, port))
        self.endpoint = f"tcp/127.0.0.1:{self.port}"

    def carried(self, data: bytes, *, outward: bool) -> None:
        if outward:
            self.sent += data
            self._on_sent(data)
        else:
            self.heard += data
