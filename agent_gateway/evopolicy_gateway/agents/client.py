"""The agent's half of the HTTP protocol: `/info`, `/task` and `/submit`, patient with a gateway that is busy or away.

Knows the three URLs and nothing else. A submit is sent with an idempotency key and `?wait=false`, then asked for until
it is done, so that no single request lasts long and a lost answer loses nothing.
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
"""With 409: nothing more is taken. Any other 409 passes by itself."""


class ProtocolError(Exception):
    """The gateway answered with something that the protocol does not allow, or stayed away too long."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A submit that was refused and cost nothing."""

    status: str
    """`budget_invalid`, `invalid_env_instance`, `run_closed`, `cancelled`."""
    message: str


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A submit that was charged."""

    name: str
    """Of its folder under `feedback/`."""
    status: str
    summary: dict[str, Any]
    """What `summary.json` says; its arrays are null unless the status is `ok`."""


@dataclass(kw_only=True)
class Client:
    """Speaks to one run's gateway."""

    info_url: str
    task_url: str
    submit_url: str
    answer_s: float = 60.0
    """A gateway that says nothing for so long is asked again."""
    timeout_s: float = 300.0
    """How long a gateway may be unreachable before giving up, seconds."""
    poll_s: float = 0.25
    """Time between questions after a submit that runs, seconds; it grows while the submit does."""
    sleep: Callable[[float], None] = field(default=time.sleep)
    clock: Callable[[], float] = field(default=time.monotonic)

    @classmethod
    def from_environment(cls) -> Client:
        """A client for the URLs in the `EVOPOLICYGYM_*` variables. KeyError when one is missing."""
        return cls(
            info_url=os.environ["EVOPOLICYGYM_INFO_URL"],
            task_url=os.environ["EVOPOLICYGYM_TASK_URL"],
            submit_url=os.environ["EVOPOLICYGYM_SUBMIT_URL"],
        )

    def info(self) -> dict[str, Any]:
        """What `/info` says now."""
        return self._expect_json(*self._request(self.info_url))

    def task(self) -> str:
        """The task's markdown."""
        status, body = self._request(self.task_url)
        if status != 200:
            raise ProtocolError(f"GET {self.task_url} answered {status}: {body[:200]!r}")
        return body.decode("utf-8", "replace")

    def submit(self, env_instances: list[int]) -> Verdict | Refusal:
        """Submit `system/` as it is now on these train cases and wait for the verdict."""
        key = uuid.uuid4().hex
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
            error = refusal.get("error") or {}
            return Refusal(
                status=str(refusal.get("status", "refused")), message=str(error.get("message", ""))
            )
        reply = self._expect_json(status, answer)
        return self._await(reply)

    def _await(self, reply: dict[str, Any]) -> Verdict:
        wait_s = self.poll_s
        index = int(reply["submit_id"])
        while reply.get("summary") is None:
            self.sleep(wait_s)
            wait_s = min(wait_s * 1.2, 8 * self.poll_s)
            reply = self._expect_json(*self._request(_extended(self.submit_url, path=str(index))))
        name = str(reply["feedback"]).rpartition("/")[2]
        return Verdict(name=name, status=str(reply["status"]), summary=reply["summary"])

    def _expect_json(self, status: int, body: bytes) -> dict[str, Any]:
        if status not in (200, 202):
            raise ProtocolError(f"unexpected answer {status}: {body[:200]!r}")
        return self._json(body)

    @staticmethod
    def _json(body: bytes) -> dict[str, Any]:
        try:
            value = json.loads(body)
        except ValueError as error:
            raise ProtocolError(f"not JSON: {body[:200]!r}") from error
        if not isinstance(value, dict):
            raise ProtocolError(f"not a JSON object: {body[:200]!r}")
        return value

    def _request(
        self, url: str, body: bytes | None = None, headers: dict[str, str] | None = None
    ) -> tuple[int, bytes]:
        """Status and body of one exchange, tried again while the gateway is away or restarting."""
        give_up_at = self.clock() + self.timeout_s
        while True:
            try:
                request = urllib.request.Request(url, data=body, headers=headers or {})
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
                raise ProtocolError(f"{url} did not answer for {self.timeout_s:g} s: {reason}") from reason
            self.sleep(self.poll_s)


# The gateway is on this machine; a proxy from the surroundings must not be asked for it.
_OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _extended(url: str, *, path: str = "", query: str = "") -> str:
    parts = urlsplit(url)
    extended = parts.path + (f"/{path}" if path else "")
    return urlunsplit((parts.scheme, parts.netloc, extended, query or parts.query, ""))


def exit_after(agent: str, play: Callable[[Client], int]) -> NoReturn:
    """Ends the program by what `play` gives: 0 for any submit that was taken, 1 for none, or no gateway."""
    try:
        taken = play(Client.from_environment())
    except ProtocolError as error:
        print(f"{agent}: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    raise SystemExit(0 if taken else 1)
