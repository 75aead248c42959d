"""Zenoh sessions and the only pattern this project uses over them: a query with one reply.

Rules that this module owns:
- Zenoh's callbacks run on its threads and only pass work to the event loop.
- Nothing is sent from the event loop: a send to a frozen peer blocks for seconds, and would expire all leases.
- Every declaration is held by an object, since dropping it undeclares it.
- Scouting is off and the admin space is closed; `access_control` below grants the rights.
- Machines connect over mutual TLS: each has a certificate, a user name and a password of its own. It has rights only if
  the certificate's common name and the user name both equal its identity.
- No process forks while it has a session open.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import queue
import re
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from evopolicy_common.errors import ConfigError, TransportError, raised_as
from evopolicy_common.logs import log
from evopolicy_common.processes.notices import notify_if_slow
from evopolicy_common.wire import keys
from evopolicy_common.wire.credentials import Credentials, MachineRole, TlsFiles, check_endpoints

MAX_MESSAGE_BYTES = 16 << 20
_REPLY_LANES = 8
_CLOSE_S = 3.0
RENEWED_LOOK_S = 2.0
"""Interval of looks for renewed credentials, seconds."""
_RENEWED_PAUSE_S = 0.1
STUCK_S = 2.0
"""Delay after a query's timeout at which the session is considered stuck, seconds."""


_Lane = queue.SimpleQueue[tuple[zenoh.Query, str, bytes] | None]


class IncomingQuery:
    """A request, to be answered once, from any coroutine or thread."""

    __slots__ = ("_query", "_server", "arrived", "key", "payload")

    def __init__(self, server: Server, query: zenoh.Query) -> None:
        self._server = server
        self._query: zenoh.Query | None = query
        self.arrived = time.monotonic()
        """Time of arrival, independent of when the event loop handles it."""
        self.key = str(query.key_expr)
        self.payload = bytes(query.payload) if query.payload is not None else b""

    def reply(self, payload: bytes, lane: int = 0) -> None:
        """Sends the reply, off the event loop. Replies of one lane keep their order; a stalled peer stalls its lane."""
        query, self._query = self._query, None
        if query is not None:
            self._server.lanes[lane % _REPLY_LANES].put((query, self.key, payload))

    def drop(self) -> None:
        """Ends the query without a reply; the client is notified at once."""
        query, self._query = self._query, None
        if query is not None:
            query.drop()  # type: ignore[no-untyped-call]


class Server:
    """A listening session that delivers queries to the event loop in batches. Created by `serve`."""

    def __init__(
        self,
        session: zenoh.Session,
        loop: asyncio.AbstractEventLoop,
        on_queries: Callable[[list[IncomingQuery]], None],
    ) -> None:
        self._session = session
        self._loop = loop
        self._on_queries = on_queries
        self._inbox: deque[IncomingQuery] = deque()
        self._scheduled = False
        self._lock = threading.Lock()
        self._held: list[Any] = []
        self.lanes: list[_Lane] = [queue.SimpleQueue() for _ in range(_REPLY_LANES)]
        """Replies, each sent by the thread of its lane; the event loop never sends."""
        for index, lane in enumerate(self.lanes):
            threading.Thread(target=_send_replies, args=(lane,), name=f"reply-{index}", daemon=True).start()

    def declare(self, expressions: Iterable[str]) -> None:
        """Starts answering queries on these key expressions."""
        for expression in expressions:
            self._held.append(self._session.declare_queryable(expression, self._arrived, complete=True))

    def watch_liveliness(self, expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Calls `on_change(key, alive)` on the event loop as liveliness tokens come and go."""

        def changed(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            self._loop.call_soon_threadsafe(on_change, str(sample.key_expr), alive)

        self._held.append(self._session.liveliness().declare_subscriber(expression, changed, history=True))

    def close(self) -> None:
        """Stops accepting queries. Replies waiting in a lane may be lost; clients send their requests again."""
        for lane in self.lanes:
            lane.put(None)
        self._held.clear()
        _close(self._session)

    def _arrived(self, query: zenoh.Query) -> None:
        incoming = IncomingQuery(self, query)
        with self._lock:
            self._inbox.append(incoming)
            if self._scheduled:
                return
            self._scheduled = True
        with contextlib.suppress(RuntimeError):  # the loop is closed: the process is exiting
            self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        with self._lock:
            batch = list(self._inbox)
            self._inbox.clear()
            self._scheduled = False
        self._on_queries(batch)


class Link:
    """A client's session. Created by `connect`; reconnects by itself while it is open."""

    def __init__(
        self,
        session: zenoh.Session,
        credentials: Credentials,
        read_again: Callable[[], Credentials] | None = None,
    ) -> None:
        """`read_again`: as for `connect`."""
        self.credentials, self._read_again, self._session = credentials, read_again, session
        self._sender = ThreadPoolExecutor(max_workers=4, thread_name_prefix="ask")
        self._alive: dict[str, Any] = {}

    @property
    def connected(self) -> bool:
        """Whether a router is connected now; a hint for messages to people."""
        return bool(self._session.info.routers_zid())

    async def query(self, key: str, payload: bytes, timeout_s: float) -> bytes:
        """Sends one query and returns its reply.

        Raises TransportError when none came within `timeout_s` seconds, or at once when nobody serves that key or the
        access rules forbid it. The request may have been carried out nevertheless: all our requests are safe to
        send again.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[bytes | None] = loop.create_future()

        def settle(value: bytes | None) -> None:
            if not future.done():
                future.set_result(value)

        def post(value: bytes | None) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits any more
                loop.call_soon_threadsafe(settle, value)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                post(bytes(reply.ok.payload))

        send = partial(
            self._session.get,
            key,
            # On Zenoh's own thread, which waits for nothing here: an indirect callback starts a thread for each query.
            zenoh.handlers.Callback(on_reply, partial(post, None), indirect=False),
            payload=payload,
            timeout=timeout_s,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        try:
            await loop.run_in_executor(self._sender, send)
            # Zenoh ends the query at `timeout_s`; the margin covers a stuck session. Not `wait_for`, which in Python
            # 3.11 swallows a cancellation that coincides with the reply.
            async with asyncio.timeout(timeout_s + STUCK_S):
                answer = await future
        except (zenoh.ZError, TimeoutError, RuntimeError) as error:
            why = str(error) or self._doubt()  # a timeout has no text
            raise TransportError(f"no answer to {_verb(key)!r} within {timeout_s:g} s; {why}") from error
        if answer is None:
            raise TransportError(f"no answer to {_verb(key)!r}; {self._doubt()}")
        return answer

    def ask_blocking(self, key: str, payload: bytes, timeout_s: float) -> bytes:
        """`query` for a dedicated thread, such as the heartbeat's."""
        with raised_as(TransportError, f"no answer to {_verb(key)!r}", zenoh.ZError):
            replies = self._session.get(
                key, payload=payload, timeout=timeout_s, congestion_control=zenoh.CongestionControl.BLOCK
            )
            for reply in replies:
                if reply.ok is not None:
                    return bytes(reply.ok.payload)
        raise TransportError(f"no answer to {_verb(key)!r}; {self._doubt()}")

    def declare_alive(self, key: str) -> None:
        """Holds a liveliness token on `key` while this link is open."""
        self._alive[key] = self._session.liveliness().declare_token(key)

    async def renewed(self, token: str) -> bool:
        """Whether the credentials no longer have this token. Waits for a session with those on disk."""
        while self.credentials.token == token:
            try:
                fresh = None if self._read_again is None else await asyncio.to_thread(self._read_again)
            except (ConfigError, OSError):
                fresh = None
            if fresh is None or fresh.token == token:
                return False
            await asyncio.sleep(_RENEWED_PAUSE_S)
        return True

    def replace(self, session: zenoh.Session, credentials: Credentials) -> None:
        """Changes to another session; open requests are sent again. Blocks until the old one is closed."""
        old, self._session, self.credentials = self._session, session, credentials
        for key in self._alive:
            self.declare_alive(key)
        _close(old)

    def close(self) -> None:
        """Closes the session. Open requests get no reply."""
        self._alive.clear()
        self._sender.shutdown(wait=False, cancel_futures=True)
        _close(self._session)

    def _doubt(self) -> str:
        where = f"is the coordinator at {', '.join(self.credentials.endpoints)} up"
        return f"{where}?" if self.credentials.tls is None else f"{where}, and {_doubt_of(self.credentials)}"


@contextlib.asynccontextmanager
async def connect(
    credentials: Credentials,
    *,
    timeout_s: float | None = 10.0,
    read_again: Callable[[], Credentials] | None = None,
) -> AsyncIterator[Link]:
    """A client session, open inside the `async with`. `read_again` reads the credentials anew, which may have been
    renewed: a session with the renewed ones then replaces the first.

    Waits until a router accepts it. Raises TransportError after `timeout_s` seconds (None: waits forever); a wrong
    password has the same effect, as the router does not report it.
    """
    with notify_if_slow(f"the coordinator at {', '.join(credentials.endpoints)}"):
        session, credentials = await _open_client(credentials, timeout_s, read_again)
    link = Link(session, credentials, read_again)
    renewing = None if read_again is None else asyncio.create_task(_take_renewed(link, read_again))
    try:
        yield link
    finally:
        if renewing is not None:
            renewing.cancel()
            await asyncio.gather(renewing, return_exceptions=True)
        await asyncio.to_thread(link.close)


async def _take_renewed(link: Link, read_again: Callable[[], Credentials]) -> None:
    """Renews the session with renewed credentials, which Zenoh reads only when it opens a session."""
    used = _content(link.credentials)
    while True:
        await asyncio.sleep(RENEWED_LOOK_S)
        try:
            fresh = await asyncio.to_thread(read_again)
            content = await asyncio.to_thread(_content, fresh)
            if content == used:
                continue
            session = await asyncio.to_thread(zenoh.open, client_config(fresh))
            await asyncio.to_thread(link.replace, session, fresh)
        except (ConfigError, OSError, zenoh.ZError) as error:
            # The folder is being copied, or the coordinator does not admit them yet.
            log.debug("renewed credentials cannot be used yet", why=str(error))
            continue
        used = content
        log.info("renewed credentials are in use", user=fresh.user)


def _content(credentials: Credentials) -> tuple[object, ...]:
    tls = credentials.tls
    paths = () if tls is None else (tls.root_ca, tls.certificate, tls.private_key)
    return credentials, *(Path(path).read_bytes() for path in paths)


@contextlib.asynccontextmanager
async def serve(
    config: zenoh.Config, on_queries: Callable[[list[IncomingQuery]], None]
) -> AsyncIterator[Server]:
    """A listening session for a `server_config`, open inside the `async with`; `declare` its key expressions."""
    try:
        session = await asyncio.to_thread(zenoh.open, config)
    except zenoh.ZError as error:
        # Zenoh adds the places in its own source, one after each cause.
        why = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))
        raise TransportError(f"cannot listen: {why}; choose another address with --listen") from error
    server = Server(session, asyncio.get_running_loop(), on_queries)
    try:
        yield server
    finally:
        await asyncio.to_thread(server.close)


def client_config(credentials: Credentials) -> zenoh.Config:
    """The configuration of a worker's, gateway's or operator's session. Raises ConfigError like `check_endpoints`."""
    check_endpoints(credentials)
    return _config(
        {
            **_COMMON,
            "mode": "client",
            "connect/endpoints": list(credentials.endpoints),
            # One attempt: opening a client blocks its thread until it is connected, so `connect` does the timeout.
            "connect/timeout_ms": 0,
            "transport/auth/usrpwd/user": credentials.user,
            "transport/auth/usrpwd/password": credentials.password,
            **_tls(credentials.tls, "connect"),
        }
    )


def server_config(
    cluster: str,
    listen: Iterable[str],
    passwords: Path,
    users: Iterable[tuple[MachineRole, str]],
    tls: TlsFiles | None = None,
) -> zenoh.Config:
    """The configuration of the coordinator's session for its own machine or, with `tls`, for other machines.

    `users`: roles, which have rights, and user names. `passwords`: a file with a line `user:password` for each.
    """
    settings = {
        **_COMMON,
        "mode": "router",
        "listen/endpoints": list(listen),
        "transport/auth/usrpwd/dictionary_file": str(passwords),
        "access_control": access_control(cluster, users, tls=tls is not None),
    }
    return _config(settings | _tls(tls, "listen"))


def site_router_settings(
    cluster: str,
    listen: Iterable[str],
    passwords: Path,
    machines: Iterable[tuple[MachineRole, str]],
    tls: TlsFiles,
    connect_to: Iterable[str],
    uplink: str,
    user: str,
    password: str,
) -> dict[str, Any]:
    """The configuration of a site's `zenohd`, by key: the coordinator's rules for its `machines`, and one
    uplink. `user` and `password` are its own; `passwords` and the files of `tls` are paths on its host."""
    return {
        **_COMMON,
        "mode": "router",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect_to),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "transport/auth/usrpwd": {"user": user, "password": password, "dictionary_file": str(passwords)},
        **_tls(tls, "listen"),
        **_tls(tls, "connect"),
        "access_control": access_control(cluster, machines, uplink),
    }


def access_control(
    cluster: str, users: Iterable[tuple[MachineRole, str]], uplink: str | None = None, *, tls: bool = True
) -> dict[str, Any]:
    """Zenoh's access rules: each role sends requests on its own keys and receives the replies, nothing else.
    `declare_queryable` goes out to clients only: else one gateway could answer another's queries.

    With `tls` a machine's name is also that in its certificate. A `router` is a site's own `zenohd`, which speaks for
    all roles behind it and has to apply these rules to them. `uplink`: the common name of the peer that such a router
    connects to; requests go there and replies come from it.
    """
    rules: list[dict[str, Any]] = []
    granted: dict[MachineRole, list[str]] = {}

    def allow(role: MachineRole, name: str, messages: list[str], flow: str, key: str) -> None:
        rule = {"id": name, "permission": "allow", "messages": messages, "flows": [flow], "key_exprs": [key]}
        rules.append(rule)
        granted.setdefault(role, []).append(name)
        granted.setdefault("router", []).append(name)

    for role, expression in keys.requests(cluster).items():
        allow(role, f"{role}_asks", ["query"], "ingress", expression)
        allow(role, f"{role}_hears", ["reply", "declare_queryable"], "egress", expression)
    allow("worker", "worker_lives", ["liveliness_token"], "ingress", keys.liveliness_key(cluster, "*"))
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for machine_role, name in users:
        over_tls = {"cert_common_names": [name], "link_protocols": ["tls"]} if tls else {}
        subjects.append({"id": name, "usernames": [name], **over_tls})
        policies.append({"subjects": [name], "rules": granted[machine_role]})
    if uplink is not None:
        opposite = {"ingress": ["egress"], "egress": ["ingress"]}
        mirrored = [
            {**rule, "id": f"{rule['id']}_above", "flows": opposite[rule["flows"][0]]} for rule in rules
        ]
        # The peer that a router connects to sends no user name; only its certificate identifies it.
        subjects.append({"id": "uplink", "cert_common_names": [uplink], "link_protocols": ["tls"]})
        policies.append({"subjects": ["uplink"], "rules": [rule["id"] for rule in mirrored]})
        rules += mirrored
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


_COMMON: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    "adminspace": {"enabled": False},
    # Zenoh itself reconnects to a lost router, often enough that its clients are back within a second.
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
}


def _tls(tls: TlsFiles | None, side: str) -> dict[str, Any]:
    if tls is None:
        return {}
    prefix = "transport/link/tls"
    return {
        f"{prefix}/root_ca_certificate": tls.root_ca,
        f"{prefix}/{side}_certificate": tls.certificate,
        f"{prefix}/{side}_private_key": tls.private_key,
        f"{prefix}/enable_mtls": True,
        f"{prefix}/verify_name_on_connect": True,
        # A link closes when the certificate with which it was opened expires.
        f"{prefix}/close_link_on_expiration": True,
    }


def _config(settings: dict[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


_PATIENCE_S = 30.0
"""A client that waits forever logs possible causes once, after this time, seconds."""


async def _open_client(
    credentials: Credentials, timeout_s: float | None, read_again: Callable[[], Credentials] | None
) -> tuple[zenoh.Session, Credentials]:
    loop = asyncio.get_running_loop()
    patience_s = _PATIENCE_S if timeout_s is None else timeout_s
    deadline = loop.time() + patience_s
    pause = 0.02
    while True:
        try:
            return await asyncio.to_thread(zenoh.open, client_config(credentials)), credentials
        except zenoh.ZError as error:
            if read_again is not None:
                with contextlib.suppress(ConfigError, OSError):  # the folder is being copied
                    credentials = await asyncio.to_thread(read_again)
            if loop.time() > deadline:
                text = (
                    f"no connection to {', '.join(credentials.endpoints)} within {patience_s:g} s: is the coordinator"
                    f" up there, and {_doubt_of(credentials)}"
                )
                if timeout_s is not None:
                    raise TransportError(text) from error
                log.warning(text)
                deadline = math.inf
        await asyncio.sleep(pause)
        pause = min(0.5, pause * 1.5)


def _doubt_of(credentials: Credentials) -> str:
    if credentials.tls is None:
        return f"are these the {credentials.role} credentials of its state folder?"
    return f"are these credentials in its `certs list` ({credentials.user}), neither expired nor revoked?"


def _send_replies(lane: _Lane) -> None:
    while (item := lane.get()) is not None:
        query, key, payload = item
        try:
            # The reply is sent like the request: blocking, never dropped.
            query.reply(key, payload)
        except zenoh.ZError:
            pass  # the client may be gone; otherwise it sends the request again
        except Exception:
            # An error in one reply must not stop the replies behind it.
            log.exception("an answer cannot be sent", key=key)
        with contextlib.suppress(Exception):
            query.drop()  # type: ignore[no-untyped-call]
        del query, item


def _close(session: zenoh.Session) -> None:
    """Closes the session, waiting at most `_CLOSE_S`: with a frozen peer closing can take many seconds."""

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]

    closer = threading.Thread(target=close, name="zenoh-close", daemon=True)
    closer.start()
    closer.join(_CLOSE_S)


def _verb(key: str) -> str:
    return key.split("/", 3)[-1]
