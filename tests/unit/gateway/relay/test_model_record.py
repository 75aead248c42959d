"""The relay's record of model calls, and replay from it."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from stages import odd_answers
from stages.model_api import Step
from stages.relay_stage import KEY, PATHS, TOKEN, Served, relay

from evopolicy_common.records import model_record
from evopolicy_common.records.model_record import Pack, read_calls, request_of
from evopolicy_gateway.relay.apis import Protocol

SECRET = "ghp_0123456789abcdefghij0123"


def recorded(
    tmp_path: Path, script: list[Step], act: Callable[[Served], Awaitable[Any]], **more: Any
) -> Served:
    more = {"record": "full", "folder": str(tmp_path / "model"), "tokens": ("a" * 32, TOKEN), **more}

    async def main() -> Served:
        async with relay(tmp_path, script, **more) as served:
            await act(served)
            return served

    return asyncio.run(main())


async def asked_once(served: Served) -> None:
    assert (await served.ask()).status_code == 200


def contents(folder: Path) -> bytes:
    """All that a record holds, unpacked."""
    with contextlib.closing(Pack(folder)) as pack:
        return (folder / "calls.jsonl").read_bytes() + b"\n".join(map(pack.get, pack.keys()))


@pytest.mark.parametrize(("path", "protocol"), PATHS.items())
def test_a_call_is_recorded_whole_and_once(tmp_path: Path, path: str, protocol: Protocol) -> None:
    said = [{"role": "user", "content": [{"type": "text", "text": "x" * 99}]}]
    field = "contents" if protocol == "google" else "input" if path == "responses" else "messages"
    name = path.partition("?")[0]

    async def act(served: Served) -> None:
        for n in range(2):
            more = [*said, {"role": "user", "content": f"turn {n}"}]
            assert "hello" in (await served.ask(path, **{field: more})).text
        models = "/v1beta/models" if protocol == "google" else "/v1/models"
        assert (await served.client.get(models)).status_code == 200

    recorded(tmp_path, [Step(text="hello"), Step(text="hello")], act, protocol=protocol)
    folder = tmp_path / "model"
    calls = read_calls(folder)
    facts = [(call.n, call.api, call.status, call.broken) for call in calls]
    assert facts == [(n, api, 200, False) for n, api in enumerate((name, name, "models"))]
    assert calls[0].digest != calls[1].digest
    with contextlib.closing(Pack(folder)) as pack:
        assert request_of(pack, calls[1])[field][-1]["content"] == "turn 1"
        assert b"hello" in pack.get(calls[0].answer)
    assert contents(folder).count(b"x" * 99) == 1


def test_no_secret_is_in_the_record_however_it_came(tmp_path: Path) -> None:
    """Attack: sends keys to its model, so that the record has them. Defence: removed by the rules of logs,
    in requests, answers and headers; encoded keys, and those split over parts of a stream, are not
    found."""
    named = "plain-words-of-a-variable"

    async def act(served: Served) -> None:
        address = f"http://127.0.0.1:1/{'a' * 32}/submit"
        for text in (f"{KEY} {SECRET}", f"Bearer {TOKEN} {named}", address):
            await served.ask(messages=[{"role": "user", "content": text}], **{SECRET: text})
        served.client.headers["x-codex-note"] = KEY

    script = [Step(text=f"{KEY} {named}"), Step(odd=odd_answers.repeats_its_headers), Step(text=SECRET)]
    recorded(tmp_path, script, act, secrets=(named,))
    held = contents(tmp_path / "model")
    assert held.count(b"[token-0]") == held.count(b"[token-1]") == 2
    for secret in (KEY, SECRET, TOKEN, named, "a" * 32):
        assert secret.encode() not in held


@pytest.mark.parametrize("limit", ["MAX_CALLS", "MAX_PACK_BYTES", "MAX_CONTENT_BYTES"])
def test_a_flood_ends_the_record_and_not_the_run(
    tmp_path: Path, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: floods the record of model calls. Defence: calls and bytes are bounded; recording stops, the
    run goes on."""
    most = 3 if limit == "MAX_CALLS" else 4000
    monkeypatch.setattr(model_record, limit, most)

    async def act(served: Served) -> None:
        for n in range(30):
            noise = secrets.token_hex(150 * n)
            assert (await served.ask(messages=[{"role": "user", "content": noise}])).status_code == 200

    served = recorded(tmp_path, [], act)
    folder = tmp_path / "model"
    assert served.used.requests == 30
    assert len([note for note in served.notes if "stops here, and the run continues" in note]) == 1
    assert 0 < len(read_calls(folder)) < 30
    assert (folder / "content.pack").stat().st_size < 200_000
    assert "limit" in (folder / "stopped").read_text() or "longer" in (folder / "stopped").read_text()
    # A relay that is started again does not go on.
    before = contents(folder)
    recorded(tmp_path, [], act)
    assert contents(folder) == before


def test_a_killed_relays_half_written_record_is_continued(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    recorded(tmp_path, [], asked_once)
    for name in ("calls.jsonl", "content.pack"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data + data[: len(data) - 3])
    recorded(tmp_path, [Step(text="another")], asked_once)
    calls = read_calls(folder)
    assert [call.n for call in calls] == [0, 1]
    with contextlib.closing(Pack(folder)) as pack:
        assert b"another" in pack.get(calls[1].answer)
        assert pack.get(calls[0].answer)


def test_digests_keep_no_content_and_off_keeps_nothing(tmp_path: Path) -> None:
    recorded(tmp_path, [], asked_once, record="off")
    assert not (tmp_path / "model").exists()
    recorded(tmp_path, [], asked_once, record="digests")
    assert {path.name for path in (tmp_path / "model").iterdir()} == {"calls.jsonl"}
    (call,) = read_calls(tmp_path / "model")
    assert call.digest
    assert not call.request


def test_a_replay_answers_from_the_record_until_a_request_differs(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        answers.append([(await served.ask(n=n)).content for n in (1, 2, 1)])
        answers.append([(await served.client.get("/v1/models")).content])

    async def again(served: Served) -> None:
        await act(served)
        assert (await served.client.get("/v1/models")).status_code == 400
        assert (await served.ask(n=1)).status_code == 400
        assert (await served.ask(n=3)).headers["x-should-retry"] == "false"

    answers: list[list[bytes]] = []
    script = [Step(text="one"), Step(text="a" * 32), Step(text=SECRET)]
    asked = recorded(tmp_path, script, act).api.n_asked
    folder, out = str(tmp_path / "model"), tmp_path / "again"
    served = recorded(tmp_path, [], again, folder=str(out), record="digests", replay=folder)
    assert (asked, served.api.n_asked) == (3, 0)
    whole = [answer.replace(SECRET.encode(), b"[redacted]") for answer in answers[0]]
    assert (answers[2], answers[3]) == (whole, answers[1])
    assert "comes after all that were recorded" in served.spent[0]
    assert served.spent[0] in (out / "difference.txt").read_text()
