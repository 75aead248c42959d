"""A coordinator that writes down every question and answer, and gives hidden things away where it is told to.

Started as `python tapped_coordinator.py TAP LEAK OPTIONS…`. TAP becomes a stream of msgpack `[way, key, payload]`, each
after its length in four bytes. While the
file LEAK exists, the numbers in it go into the task's text, and they and every return that a worker reports go,
compressed, into the output of the episodes that gateways are told of: leaks that a search has to find.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import msgspec
import zenoh
import zstandard

from evopolicy_common.messages.gateway import ResultsPage, RunOpened
from evopolicy_common.messages.worker import ReportResults
from evopolicy_common.wire import codec
from evopolicy_common.wire.transport import IncomingQuery, Server
from evopolicy_coordinator.cli import main as cli


def tap(file: Path, leak: Path) -> None:
    """Puts itself between every coordinator session of this process and its peers."""
    out = file.open("ab", buffering=0)
    lock = threading.Lock()
    returns: list[float] = []
    reply, arrived = IncomingQuery.reply, Server._arrived

    def note(way: str, key: str, payload: bytes) -> None:
        data = msgspec.msgpack.encode((way, key, payload))
        with lock:
            out.write(len(data).to_bytes(4, "big") + data)

    def leaky(payload: bytes) -> bytes:
        page = codec.decode(codec.gateway_replies, payload)
        seeds = msgspec.json.decode(leak.read_bytes(), type=list[int])
        if isinstance(page, RunOpened):
            env = msgspec.structs.replace(page.env, task_text=f"{page.env.task_text}\n{seeds}")
            return codec.encode(msgspec.structs.replace(page, env=env))
        if not isinstance(page, ResultsPage):
            return payload
        planted = zstandard.compress(msgspec.msgpack.encode({"seeds": seeds, "returns": returns}))
        episodes = [msgspec.structs.replace(one, stdout=one.stdout + planted) for one in page.episodes]
        return codec.encode(msgspec.structs.replace(page, episodes=tuple(episodes)))

    def tapped_reply(self: IncomingQuery, payload: bytes, lane: int = 0) -> None:
        if "/gw/" in self.key and leak.exists():
            payload = leaky(payload)
        note("answer", self.key, payload)
        reply(self, payload, lane)

    def tapped_arrived(self: Server, query: zenoh.Query) -> None:
        asked = IncomingQuery(self, query)
        note("question", asked.key, asked.payload)
        if asked.key.endswith("/work/done"):
            message = codec.decode(codec.worker_requests, asked.payload)
            assert isinstance(message, ReportResults)
            returns.extend(one.episode_return for result in message.results for one in result.episodes)
        arrived(self, query)

    IncomingQuery.reply = tapped_reply  # type: ignore[method-assign]
    Server._arrived = tapped_arrived  # type: ignore[method-assign]


if __name__ == "__main__":
    tap(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.argv[1:3] = []
    cli.main()
