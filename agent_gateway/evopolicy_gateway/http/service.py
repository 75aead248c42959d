"""The agent's HTTP service: `/info`, `/task`, `/submit`, all below a secret path token.

- The token is compared in constant time; every path without it gets the same 404.
- When the service is open to other hosts, a bearer token is checked first; without it every request gets the same 401.
- No part of a request is ever used as a path of the file system.
- A body is read only up to the maximum length of a submit.
- An error names what the agent can act on, and nothing of this machine.
- No answer depends on whether its client is still connected.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import math
from collections.abc import Mapping
from typing import Any

import msgspec
import orjson
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from evopolicy_common import published_forms
from evopolicy_common.errors import RequestError
from evopolicy_common.logs import log
from evopolicy_common.messages.gateway import CANCELLED, RunState
from evopolicy_common.records.run_record import PROTOCOL_VERSION
from evopolicy_gateway.http.task import task_markdown
from evopolicy_gateway.submits.pipeline import SubmitPipeline
from evopolicy_gateway.submits.submit_request import MAX_BODY_BYTES, refuse_size
from evopolicy_gateway.submits.tickets import RUN_CLOSED, ConflictError, Ticket, TicketMachine
from evopolicy_gateway.workspace.agents_md import LAST_WORDS_S

BODY_WAIT_S = 30.0
"""A body must arrive within this time, seconds."""
DECIDED_WAIT_S = 5.0
"""How long `?wait=false` waits for the coordinator's acceptance before it answers 202 regardless, seconds."""
MAX_KEY_CHARS = 200
LINGER = (256 << 20, 120.0)
"""Limits, in bytes and seconds, for reading the rest of a refused body before the connection is closed."""
STRANGER_LINGER = (MAX_BODY_BYTES, 10.0)
"""The same for a client without the bearer token."""


def make_app(pipeline: SubmitPipeline, token: str, bearer: str = "") -> ASGIApp:
    """Builds the service of one run. An empty `bearer` means that no bearer token is required."""
    machine = pipeline.machine
    task = task_markdown(machine.run).encode()

    async def info(request: Request) -> Response:
        await pipeline.refresh()
        left = None
        with contextlib.suppress(OSError, msgspec.DecodeError):
            left = msgspec.json.decode(pipeline.folder.left.read_bytes(), type=dict[str, int])
        return _json(200, info_document(machine, left))

    async def task_text(request: Request) -> Response:
        return Response(task, media_type="text/markdown; charset=utf-8")

    async def submit(request: Request) -> Response:
        key = request.headers.get("idempotency-key")
        if key is not None and not (0 < len(key) <= MAX_KEY_CHARS and key.isprintable()):
            raise RequestError(
                "budget_invalid", f"an Idempotency-Key has 1 to {MAX_KEY_CHARS} printable characters"
            )
        wait = request.query_params.get("wait", "true").lower()
        if wait not in ("true", "false"):
            raise RequestError("budget_invalid", "the query parameter wait is 'true' or 'false'")
        try:
            body = await _read_body(request)
        except RequestError as error:
            await pipeline.note_rejected(error)
            raise
        ticket = await pipeline.submit(body, key)
        if wait == "true":
            await pipeline.until(lambda: ticket.done)
        else:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(DECIDED_WAIT_S):
                    await pipeline.until(lambda: ticket.decided)
        return _of_ticket(ticket, pipeline)

    async def ask_submit(request: Request) -> Response:
        ticket = machine.find(request.path_params["submit_id"])
        if ticket is None:
            raise HTTPException(404)
        return _of_ticket(ticket, pipeline)

    async def finalize(request: Request) -> Response:
        raise HTTPException(405)

    app = Starlette(
        routes=[
            Route("/info", info, methods=["GET"]),
            Route("/task", task_text, methods=["GET"]),
            Route("/submit", submit, methods=["POST"]),
            Route("/submit/{submit_id}", ask_submit, methods=["GET"]),
            # The published service finalises a run by itself and answers this path with 405.
            Route("/finalize", finalize, methods=["GET", "POST"]),
        ],
        exception_handlers=dict.fromkeys((HTTPException, RequestError, ClientDisconnect, Exception), _failed),
    )
    app.router.redirect_slashes = False
    return _TokenGate(app, token, bearer)


def _of_ticket(ticket: Ticket, pipeline: SubmitPipeline) -> Response:
    """The answer to a submit: its summary as in the file, byte for byte, or its progress. Raises its refusal."""
    if ticket.error is not None:
        raise ticket.error
    summary = pipeline.summary(ticket)
    if summary is None:
        return _json(202, progress_document(ticket))
    head = {
        "submit_id": ticket.index,
        "status": ticket.status,
        "is_finalized": pipeline.machine.finalizes(ticket),
        "feedback": f"feedback/{ticket.submit_id}",
        "policy_failures": ticket.policy_failures,
        "warning": ticket.warning,
    }
    body = orjson.dumps(head)[:-1] + b',"summary":' + summary + b"}"
    return Response(body, media_type="application/json")


async def _read_body(request: Request) -> bytes:
    """Returns the body. Raises RequestError as soon as it is known to be too long, or when it arrives too late."""
    length = request.headers.get("content-length", "")
    if length.isdecimal() and (len(length) > 18 or int(length) > MAX_BODY_BYTES):
        refuse_size(int(length[:18]))
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_WAIT_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > MAX_BODY_BYTES:
                    refuse_size(None)
    except TimeoutError as error:
        raise RequestError("budget_invalid", f"the body did not arrive within {BODY_WAIT_S:g} s") from error
    return bytes(body)


def _json(status: int, document: dict[str, object], headers: Mapping[str, str] | None = None) -> Response:
    return Response(orjson.dumps(document), status, headers, "application/json")


_CODES = {"conflict": 409, RUN_CLOSED: 409, CANCELLED: 409, "closed": 503, "gateway_failed": 500}
"""HTTP status codes by the status of a refusal; 400 for others."""
_ANSWERS = {
    401: (None, "this service needs a bearer token"),
    404: ("not_found", "unknown endpoint"),
    405: ("method_not_allowed", "this URL does not take this method"),
    500: (None, "the gateway failed; nothing was changed by this request"),
}
"""Status and message by HTTP status code."""
_STRANGER = HTTPException(401, headers={"WWW-Authenticate": "Bearer"})
_STOPPING = RequestError(
    "closed",
    "the gateway stops; accepted submits continue: send the request again, with the same Idempotency-Key",
)


def _refusal(error: Exception) -> Response:
    """The answer to a request that fails."""
    status: str | None
    if isinstance(error, RequestError):
        code, status, message = _CODES.get(error.status, 400), error.status, error.message
    else:
        code = error.status_code if isinstance(error, HTTPException) else 500
        status, message = _ANSWERS.get(code, ("bad_request", "the request cannot be served"))
    document: dict[str, Any] = {} if status is None else {"status": status}
    document["error"] = {"message": message}
    if isinstance(error, ConflictError):
        document["submit_id"] = error.index
    return _json(code, document, getattr(error, "headers", None))


async def _failed(request: Request, error: Exception) -> Response:
    if isinstance(error, ClientDisconnect):
        return Response(status_code=400)
    if not isinstance(error, HTTPException | RequestError):
        log.error("request failed", path=request.url.path[-80:], exc_info=error)
    return _refusal(error)


class _TokenGate:
    """Removes the token from requests that carry it. Lets a client that is still sending receive a refusal."""

    def __init__(self, app: ASGIApp, token: str, bearer: str) -> None:
        self._app = app
        self._token = token.encode()
        self._bearer = bearer.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        if self._bearer and not self._bears(scope):
            stranger = _Exchange(scope, receive, send, STRANGER_LINGER)
            await _refusal(_STRANGER)(scope, stranger.receive, stranger.send)
            return
        _, _, rest = scope["path"].partition("/")
        token, slash, path = rest.partition("/")
        if not hmac.compare_digest(token.encode("utf-8", "surrogateescape"), self._token):
            path = slash = ""
        inner = dict(scope) | {"path": slash + path, "raw_path": None, "root_path": ""}
        exchange = _Exchange(scope, receive, send, LINGER)
        try:
            await self._app(inner, exchange.receive, exchange.send)
        except asyncio.CancelledError:
            # The service stops while this request waits. The cancellation may end here: the server only waits for this
            # to return.
            if not exchange.answered:
                await _refusal(_STOPPING)(scope, exchange.receive, exchange.send)

    def _bears(self, scope: Scope) -> bool:
        """Whether the request carries the bearer token in exactly one header."""
        given = [value for name, value in scope["headers"] if name == b"authorization"]
        kind, _, word = b"".join(given[:1]).partition(b" ")
        alike = hmac.compare_digest(word.strip(), self._bearer)
        return alike and len(given) == 1 and kind.lower() == b"bearer"


class _Exchange:
    """Delays the end of a refusal until the rest of the body was read and discarded, within limits.

    A server that closes while the client still sends resets the connection, and the client never reads the refusal.
    """

    def __init__(self, scope: Scope, receive: Receive, send: Send, linger: tuple[int, float]) -> None:
        self._left, self._linger_s = linger
        self._receive = receive
        self._send = send
        self._refused = False
        self.answered = False
        # A client that waits for "100 Continue" sends no body to a refusal.
        self._unread = (b"expect", b"100-continue") not in scope["headers"]

    async def receive(self) -> Message:
        message = await self._receive()
        if message["type"] != "http.request" or not message.get("more_body", False):
            self._unread = False
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._refused = message["status"] >= 400
            self.answered = True
        last = message["type"] == "http.response.body" and not message.get("more_body", False)
        if not (last and self._refused and self._unread):
            await self._send(message)
            return
        await self._send({**message, "more_body": True})
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._linger_s):
                while self._unread and self._left > 0:
                    self._left -= len((await self.receive()).get("body", b""))
        await self._send({"type": "http.response.body", "body": b"", "more_body": False})


def info_document(machine: TicketMachine, left: Mapping[str, object] | None = None) -> dict[str, Any]:
    """The document of `GET /info`: everything that an agent may know of the run, as plain values.

    `left`: of the agent's own limits.
    """
    run, state = machine.run, machine.state
    env = run.env
    env_meta: dict[str, object] = {"env": env.env, "env_version": env.env_version}
    env_meta |= {"n_env_instances": run.n_env_instances, "max_episode_steps": run.announced_steps}
    env_meta |= {"obs_space": env.obs_space, "action_space": env.action_space, "obs_storage": env.obs_storage}
    if run.profile != "own":
        env_meta |= published_forms.described(env.obs_space, env.action_space, env.obs_storage)
    elif names := env.reward_components:
        env_meta["reward_components"] = {name: env.reward_texts.get(name, "") for name in names}
    rollout_wall_s = min(run.limits.episode_wall_s, run.limits.submit_wall_s or math.inf)
    return {
        "protocol_version": PROTOCOL_VERSION,
        "state": {
            "remaining_budget": state.remaining_budget,
            "n_submits": state.n_submits,
            "is_finalized": machine.spent or state.is_finalized,
        },
        "env_meta": env_meta,
        "episode_ends_after": min(env.max_episode_steps, run.announced_steps),
        "episode_budget": run.episode_budget,
        "min_episodes_per_submit": run.min_episodes_per_submit,
        "max_episodes_per_submit": run.max_episodes_per_submit,
        "resource_limits": {"rollout_wall_s": rollout_wall_s} | msgspec.to_builtins(run.limits),
        "allowed_imports": list(run.allowed_imports),
        "denied_imports": list(run.denied_imports),
        "policy_scope": run.policy_scope,
        "finish": run.finish,
        "feedback": run.feedback,
        "observations": run.observations,
        "sandbox_tier": run.sandbox_tier,
        "video": run.video,
        "deterministic": env.deterministic,
        "end_grace_s": LAST_WORDS_S,
        "last_warning": machine.last_warning,
        "submit_in_flight": machine.in_flight and progress_document(machine.in_flight, state),
        **({} if left is None else {"left": left}),
    }


def progress_document(ticket: Ticket, state: RunState | None = None) -> dict[str, Any]:
    """The progress of a running submit, and the reason it waits when no episode of it runs.

    `held_s`: seconds of waiting because the cluster's other work used the machines; they count against no limit.
    """
    n_done, waits_for, held_s = ticket.n_done, ticket.waits_for, ticket.held_s
    if state is not None and ticket.accepted is not None and state.n_submits == ticket.index + 1:
        n_done, waits_for = max(n_done, state.n_done), waits_for or state.waits_for
        held_s = max(held_s, state.open_held_s)
    return {
        "submit_id": ticket.index,
        "status": "running",
        "n_episodes": ticket.n_episodes,
        "n_done": n_done,
        "waits_for": waits_for,
        "held_s": round(held_s, 1),
    }
