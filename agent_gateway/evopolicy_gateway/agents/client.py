"""A client of the HTTP protocol for agents: `/info`, `/task` and `/submit`, with retries while the gateway is busy or
away.

It knows the three URLs, and a remote agent's token. It sends a submit with an idempotency key and `?wait=false`, then
polls until the submit is done. So no single request lasts long, and a lost reply loses nothing.
"""

from __future__ import annotations

import json
import os
import sys
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from http.client import HTTPException
from typing import Any, NoReturn
from urllib.parse import urlsplit, urlunsplit

_OVER = ("run_closed", "cancelled")
"""Statuses of a final 409: no more submits are accepted. Any other 409 is temporary."""


class GatewayError(Exception):
    """The gateway's reply violates the protocol, or the gateway was unreachable for too long."""


@dataclass(frozen=True, kw_only=True)
class RefusedSubmit:
    """A submit that was refused and not charged."""

    status: str
    """`budget_invalid`, `invalid_env_instance`, `run_closed`, `cancelled`."""
    message: str


@dataclass(frozen=True, kw_only=True)
class ChargedSubmit:
    """The result of a submit that was charged."""

    name: str
    """Name of its folder under `feedback/`."""
    status: str
    summary: dict[str, Any]
    """The content of `summary.json`; its arrays are null unless the status is `ok`."""


@dataclass(kw_only=True)
class Client:
    info_url: str
    task_url: str
    submit_url: str
    token: str = ""
    """Bearer token of a remote agent; empty: none is sent."""
    answer_s: float = 60.0
    """Timeout of one request, seconds; after it the request is sent again."""
    timeout_s: float = 300.0
    """How long the gateway may be unreachable before the client gives up, seconds."""
    poll_s: float = 0.25
    """First pause between polls of a running submit, seconds; it grows up to eight times that."""
    sleep: Callable[[float], None] = field(default=time.sleep)
    clock: Callable[[], float] = field(default=time.monotonic)

    @classmethod
    def from_environment(cls) -> Client:
        """A client for the URLs in the `EVOPOLICYGYM_*` variables. Raises GatewayError when one is missing."""
        try:
            return cls(
                info_url=os.environ["EVOPOLICYGYM_INFO_URL"],
                task_url=os.environ["EVOPOLICYGYM_TASK_URL"],
                submit_url=os.environ["EVOPOLICYGYM_SUBMIT_URL"],
                token=os.environ.get("EVOPOLICYGYM_TOKEN", ""),
            )
        except KeyError as error:
            raise GatewayError(f"{error} is not set; it is started by a gateway") from None

    def info(self) -> dict[str, Any]:
        """The present content of `/info`."""
        return self._expect_json(*self._request(self.info_url))

    def task(self) -> str:
        """The task's text, Markdown."""
        status, body = self._request(self.task_url)
        if status != 200:
            raise GatewayError(f"GET {self.task_url} answered {status}: {body[:200]!r}")
        return body.decode("utf-8", "replace")

    def submit(self, env_instances: list[int], key: str | None = None) -> ChargedSubmit | RefusedSubmit:
        """Submits the present `system/` on these train cases and waits for the verdict. `key`: of a submit that may
        have been sent before; None: a new one."""
        key = key or uuid.uuid4().hex
        body = json.dumps({"env_instances": env_instances}).encode()
        headers = {"Content-Type": "application/json", "Idempotency-Key": key}
        while True:
            status, answer = self._request(_extended(self.submit_url, query="wait=false"), body, headers)
            if status != 409 or self._json(answer).get("status") in _OVER:
                break
            # Another submit runs, perhaps of an agent that was here before us: it ends by itself.
            self.sleep(self.poll_s)
        if status in (400, 409):
            refusal = self._json(answer)
            message = (refusal.get("error") or {}).get("message", "")
            return RefusedSubmit(status=str(refusal.get("status", "refused")), message=str(message))
        reply = self._expect_json(status, answer)
        wait_s, index = self.poll_s, int(reply["submit_id"])
        while reply.get("summary") is None:
            self.sleep(wait_s)
            wait_s = min(wait_s * 1.2, 8 * self.poll_s)
            reply = self._expect_json(*self._request(_extended(self.submit_url, path=str(index))))
        name = str(reply["feedback"]).rpartition("/")[2]
        return ChargedSubmit(name=name, status=str(reply["status"]), summary=reply["summary"])

    def _expect_json(self, status: int, body: bytes) -> dict[str, Any]:
        if status not in (200, 202):
            raise GatewayError(f"unexpected answer {status}: {body[:200]!r}")
        return self._json(body)

    @staticmethod
    def _json(body: bytes) -> dict[str, Any]:
        try:
            value = json.loads(body)
        except ValueError as error:
            raise GatewayError(f"not JSON: {body[:200]!r}") from error
        if not isinstance(value, dict):
            raise GatewayError(f"not a JSON object: {body[:200]!r}")
        return value

    def _request(
        self, url: str, body: bytes | None = None, headers: dict[str, str] | None = None
    ) -> tuple[int, bytes]:
        """Status and body of one request, retried while the gateway is away or restarting."""
        give_up_at = self.clock() + self.timeout_s
        bearer = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        while True:
            try:
                request = urllib.request.Request(url, data=body, headers=bearer | (headers or {}))
                with _OPENER.open(request, timeout=self.answer_s) as response:
                    return response.status, response.read()
            except urllib.error.HTTPError as error:
                with error:
                    if error.code < 500:
                        return error.code, error.read()
                    reason: Exception = error
            except (OSError, HTTPException) as error:
                reason = error
            if self.clock() >= give_up_at:
                raise GatewayError(f"{url} did not answer for {self.timeout_s:g} s: {reason}") from reason
            self.sleep(self.poll_s)


# The gateway is on this machine, so a proxy of the environment must not be used.
_OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _extended(url: str, *, path: str = "", query: str = "") -> str:
    parts = urlsplit(url)
    extended = parts.path + (f"/{path}" if path else "")
    return urlunsplit((parts.scheme, parts.netloc, extended, query or parts.query, ""))


def exit_after(agent: str, play: Callable[[Client], int]) -> NoReturn:
    """Exits with 0 when `play` returns that any submit was accepted, and with 1 otherwise, or without a gateway."""
    try:
        accepted = play(Client.from_environment())
    except GatewayError as error:
        print(f"{agent}: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    raise SystemExit(0 if accepted else 1)
