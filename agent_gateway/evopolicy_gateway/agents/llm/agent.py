"""The loop of a turn: ask the model, run the commands that it calls, answer, until it calls none."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TextIO

from evopolicy_gateway.agents.llm import shell
from evopolicy_gateway.agents.llm.conversation import ApiError, Conversation, ModelReply, ToolCall


class Session:
    """A conversation in a file of the agent's home."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self) -> bytes:
        """The conversation; empty when the first turn failed before anything was saved."""
        return self._path.read_bytes() if self._path.exists() else b""

    def save(self, conversation: Conversation) -> None:
        """Saves it; a program that is killed meanwhile leaves the earlier one."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._path.with_suffix(".part")
        part.write_bytes(conversation.dumped())
        os.replace(part, self._path)


class EventWriter:
    """The turn's events, one JSON line each."""

    def __init__(self, out: TextIO, session: str) -> None:
        self._out = out
        self._n = 0
        self._session: str | None = session

    def saved(self) -> None:
        """The session can be resumed from now on."""
        if self._session is not None:
            self._emit({"type": "system", "subtype": "init", "session_id": self._session})
            self._session = None

    def reply(self, reply: ModelReply) -> None:
        """The model's text and tool calls, and the tokens that they took."""
        blocks: list[dict[str, Any]] = [{"type": "text", "text": reply.text}] if reply.text else []
        blocks += [
            {"type": "tool_use", "id": one.id, "name": one.name, "input": one.given} for one in reply.calls
        ]
        self._n += 1
        message = {"id": f"m{self._n}", "role": "assistant", "content": blocks, "usage": reply.usage}
        self._emit({"type": "assistant", "message": message})

    def output(self, call: ToolCall, text: str, *, succeeded: bool) -> None:
        block = {"type": "tool_result", "tool_use_id": call.id, "content": text, "is_error": not succeeded}
        self._emit({"type": "user", "message": {"role": "user", "content": [block]}})

    def done(self, text: str) -> None:
        self._emit({"type": "result", "is_error": False, "result": text})

    def failed(self, failure: ApiError) -> None:
        """The request that ended the turn."""
        wait = "" if failure.retry_after_s is None else f"; try again in {failure.retry_after_s:g} s"
        result = {"is_error": True, "api_error_status": failure.status, "result": f"{failure}{wait}"}
        self._emit({"type": "result", **result})

    def _emit(self, event: dict[str, object]) -> None:
        print(json.dumps(event), file=self._out, flush=True)


MAX_FAULTY = 3
"""Faulty answers in a row that end a turn: a model that has not understood the tool would go on without end, and be
paid for it."""
_TOLD, _MAX_SAME = 5, 10
"""How often the same command with the same output comes in a row until the model is told, and until the turn ends."""


async def play_turn(api: Conversation, prompt: str, session: Session, events: EventWriter) -> int:
    """Plays one turn and returns the program's exit status."""
    api.say(prompt)
    n_faulty = n_same = 0
    last: tuple[str, str] | None = None
    while True:
        try:
            reply = await api.ask_model()
        except ApiError as failure:
            if failure.too_long and api.shorten():
                continue
            events.failed(failure)
            return 1
        events.reply(reply)
        outputs: list[str] = []
        for call in reply.calls:
            fault = call.fault and (reply.fault or call.fault)
            text, succeeded = (fault, False) if fault else shell.run(call.command, call.timeout_s)
            n_same = n_same + 1 if (call.command, text) == last else 1
            last = (call.command, text)
            if n_same >= _TOLD and not fault:
                text += f"\n[This was the {n_same}th time in a row with this output. Do something else.]"
            events.output(call, text, succeeded=succeeded)
            outputs.append(text)
        faults = [reply.fault] if not reply.calls else [call.fault for call in reply.calls]
        n_faulty = n_faulty + 1 if all(faults) else 0
        if reply.calls:
            api.answer(reply.calls, outputs)
        # Only here every call has its answer, as all APIs require of a conversation.
        session.save(api)
        events.saved()
        why = f"{n_faulty} faulty answers in a row, the last: {reply.fault or faults[-1]}"
        if n_same >= _MAX_SAME and not n_faulty:
            why = f"{n_same} times in a row the same command with the same output: {last and last[0]}"
        elif n_faulty < MAX_FAULTY:
            why = ""
        if why:
            events.failed(ApiError(why))
            return 1
        if not reply.calls and not reply.fault:
            events.done(reply.text)
            return 0
        if not reply.calls:
            api.say(f"[{reply.fault}]")
        if reply.context > api.context_tokens:
            api.shorten()
