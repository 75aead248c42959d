"""Whole runs of agents with a model, behind the relay: what is counted, limited and told, and where the key is."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import Command, command, record_in, run_arguments, run_dir, toy_cluster
from stages import odd_answers
from stages.model_api import CACHED, INPUT, OUTPUT, ModelApi, Step, llm_agent
from stages.provider_api import FRESH, ProviderApi, Said
from stages.provider_api import OUTPUT as ANSWERED
from waiting import wait_until

from evopolicy_common.records import model_record
from evopolicy_common.records.run_record import ModelUse, RunRecord, Tokens
from evopolicy_gateway.relay.limits import read_ledger

pytestmark = [pytest.mark.system, pytest.mark.slow]

KEY = "key-of-the-test-0123456789"
SUBMIT = Step(command="curl -s -X POST -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL")
ENDS = [SUBMIT, SUBMIT, SUBMIT, Step(text="done")]
"""Spends the budget of six episodes."""
SEARCH = """
import os
import re
needle, found = b"-".join((b"key", b"of", b"the", b"test", b"0123456789")), []
def look(path):
    try:
        with open(path, "rb") as file:
            while (data := file.read(1 << 20)):
                if needle in data:
                    found.append(path)
    except OSError:
        pass
for root, folders, files in os.walk("/"):
    folders[:] = [f for f in folders if os.path.join(root, f) not in ("/usr", "/sys", "/proc", "/dev", "/lib", BASE)]
    for name in files:
        if os.path.isfile(os.path.join(root, name)):
            look(os.path.join(root, name))
for pid in filter(str.isdecimal, os.listdir("/proc")):
    for name in ("environ", "cmdline") if int(pid) != os.getpid() else ("environ",):
        look(f"/proc/{pid}/{name}")
print("searched", len(found), found)
"""


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with toy_cluster(tmp_path_factory.mktemp("cluster")) as file:
        yield file


@pytest.fixture(autouse=True)
def the_key_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODEL_ACCESS", KEY)


def used_in(record: RunRecord) -> tuple[ModelUse, Tokens]:
    """The run's use of its model."""
    assert record.agent.model_use is not None
    assert record.agent.tokens is not None
    return record.agent.model_use, record.agent.tokens


def played(
    folder: Path, operator: Path, script: list[Step], api_name: str = "chat", **more: Any
) -> tuple[RunRecord, ModelApi, str]:
    """The record of a run, the API that it used, and what the command said."""
    with (
        ModelApi(script) as api,
        command(
            folder, *run_arguments(operator, llm_agent(folder, api.base_url, api_name, **more))
        ) as running,
    ):
        running.wait()
        return record_in(run_dir(folder)), api, running.text


@pytest.mark.timeout(600)  # the provider asks for pauses, and a busy machine adds its own
def test_odd_answers_are_counted_as_they_were_given(tmp_path: Path, operator: Path) -> None:
    usage = {"prompt_tokens": -5, "completion_tokens": "many"}
    odd = [
        odd_answers.busy(429, retry_after="0"),
        odd_answers.busy(429),
        odd_answers.busy(500, retry_after="0"),
        odd_answers.stream(odd_answers.says("x" * 40, end=False), whole=False),
        odd_answers.bomb,
    ]
    talks = [odd_answers.stream(odd_answers.says("y" * 40))]
    talks += [odd_answers.stream(odd_answers.says("z" * 40), {"choices": [], "usage": usage})]
    script = [SUBMIT, *(Step(odd=each) for each in odd + talks), *ENDS[1:]]
    record, api, text = played(tmp_path, operator, script)
    used, tokens = used_in(record)
    assert record.outcome.status == "completed"
    assert (used.metering, used.requests, used.requests_failed) == ("relay", api.n_asked, len(odd))
    assert used.models == {"m-1": len(script) - 4}
    assert used.requests_estimated == 4
    assert tokens.cache_read == api.n_answered * CACHED
    assert tokens.output - api.n_answered * OUTPUT >= 30
    assert "answered 429; next try in 0 s, at" in text
    assert KEY not in text


@pytest.mark.parametrize("api_name", ["chat", "messages"])
def test_the_key_is_nowhere_in_the_jail(tmp_path: Path, operator: Path, api_name: str) -> None:
    """Attack: searches every file and process of its jail for the key. Defence: the key is in the relay
    alone; an answer that repeats it is changed."""
    base = json.dumps(os.path.realpath(os.sys.base_prefix))  # type: ignore[attr-defined]
    search = f"cat > /tmp/s.py <<'E'\nBASE = {base}\n{SEARCH}\nE\npython3 -P /tmp/s.py; env"
    record, api, _ = played(tmp_path, operator, [Step(command=search), *ENDS], api_name)
    assert used_in(record)[0].requests == api.n_asked == 5
    assert api.keys == {KEY if api_name == "messages" else f"Bearer {KEY}"}
    sent = json.dumps(api.requests[1])
    assert "searched 0 []" in sent
    assert "EVOPOLICYGYM_SUBMIT_URL" in sent
    # Its commands have the relay's token as little as the key.
    assert "_API_KEY=" not in sent
    assert KEY not in "".join(
        path.read_text(errors="replace") for path in (run_dir(tmp_path) / "logs").rglob("*") if path.is_file()
    )


@pytest.mark.parametrize(
    ("script", "told", "asked"),
    [
        ([Step(odd=odd_answers.page)], "answered 200 with text/html", 1),
        ([Step(status=401, text="no such key")], "no such key", 1),
        ([Step(status=404, text="no such model")], "no such model", 1),
        ([Step(unknown="edit_file")] * 20, "3 faulty answers in a row, the last: there is no tool", 6),
    ],
)
def test_a_model_that_cannot_play_ends_the_run_with_the_reason(
    tmp_path: Path, operator: Path, script: list[Step], told: str, asked: int
) -> None:
    record, api, text = played(tmp_path, operator, [*script, *ENDS])
    assert (record.outcome.closed_reason, record.agent.harness) == ("agent_failed", "llm")
    assert told in text
    assert record.agent.model_use is not None
    assert record.agent.model_use.requests == api.n_asked == asked
    if script[0].unknown:
        log = (run_dir(tmp_path) / "logs/agent.jsonl").read_text()
        assert '"name": "edit_file", "input": {"path": "policy.py"}' in log


def test_an_agent_is_told_what_is_left_of_its_time_and_tokens(tmp_path: Path, operator: Path) -> None:
    wait = (
        "for n in $(seq 200); do curl -s --noproxy '*' $EVOPOLICYGYM_INFO_URL > info;"
        " grep -q model_tokens info && break; sleep 0.1; done; cat info"
    )
    _, api, _ = played(tmp_path, operator, [Step(command=wait), *ENDS], max_tokens=10**6)
    prompt = api.requests[0]["messages"][1]["content"]
    assert re.search(
        r" Left: 11 h 59 min of time, 1,000,000 tokens|Left: 12 h 00 min of time, 1,000,000", prompt
    )
    told = re.search(
        r'\\"left\\": ?{\\"wall_time_s\\": ?(\d+), ?\\"model_tokens\\": ?(\d+)}', json.dumps(api.requests[1])
    )
    assert told is not None, api.requests[1]
    assert 42_000 < int(told[1]) <= 43_200
    assert 0 < int(told[2]) <= 10**6


def test_a_spent_model_budget_ends_the_run_with_what_it_has(tmp_path: Path, operator: Path) -> None:
    record, api, text = played(tmp_path, operator, [SUBMIT, *[Step(command="true")] * 9], max_requests=3)
    assert (record.outcome.status, record.outcome.closed_reason) == ("completed", "model_budget_spent")
    assert record.outcome.budget_used == 2
    use, _ = used_in(record)
    assert (use.requests, use.limits.max_requests, use.limits.max_tokens) == (3, 3, 100_000_000)
    assert api.n_asked == 3
    assert "model limits: 3 requests, 100,000,000 tokens; metering: relay" in text
    assert "the model budget is spent: 3 requests" in text


def test_a_program_that_hangs_is_counted_and_resumed(tmp_path: Path, operator: Path) -> None:
    script = [Step(odd=odd_answers.hang(35.0)), *ENDS]
    record, api, _ = played(tmp_path, operator, script, silence_s=25.0)
    use, _ = used_in(record)
    assert (record.outcome.status, record.agent.retries) == ("completed", 1)
    assert (use.requests, use.requests_failed) == (api.n_asked, 1)


def test_a_cancelled_run_has_all_that_it_used(tmp_path: Path, operator: Path) -> None:
    script = [SUBMIT, Step(text="one"), *(Step(command=f"sleep 0.2{n}") for n in range(99))]
    with (
        ModelApi(script) as api,
        command(tmp_path, *run_arguments(operator, llm_agent(tmp_path, api.base_url))) as running,
    ):
        wait_until(lambda: api.n_asked >= 6)
        running.process.send_signal(signal.SIGINT)
        running.wait()
        record = record_in(run_dir(tmp_path))
    use, tokens = used_in(record)
    told = re.search(
        r"model use: (\d+) requests .* tokens: input noncached ([\d,]+), .*; no prices known", running.text
    )
    assert told is not None, running.text
    assert (int(told[1]), int(told[2].replace(",", ""))) == (use.requests, tokens.input_noncached)
    assert record.outcome.status == "cancelled"
    assert (record.agent.harness, record.agent.model_string, record.agent.turns) == ("llm", "m-1", 1)
    assert record.agent.cli_version is not None
    assert use.requests == api.n_asked
    assert tokens.output == (api.n_asked - use.requests_failed) * OUTPUT
    assert use.reported is not None


@pytest.mark.parametrize("victim", ["relay", "supervisor", "command", "everything"])
def test_a_kill_loses_no_finished_request(tmp_path: Path, operator: Path, victim: str) -> None:
    """Attack: kills or ends processes so that requests are not counted. Defence: the ledger is written
    before an answer ends."""
    script = [SUBMIT, *(Step(command=f"sleep 0.1{n}") for n in range(12)), *ENDS[1:]]
    with ModelApi(script) as api:
        arguments = run_arguments(operator, llm_agent(tmp_path, api.base_url))
        with command(tmp_path, *arguments) as running:
            wait_until(lambda: api.n_asked >= 5)
            kill(running, victim)
            if victim in ("relay", "supervisor"):
                assert running.wait() == 0, running.text
        if victim in ("command", "everything"):
            ledger = read_ledger(run_dir(tmp_path) / "logs/model_requests.jsonl")
            assert api.n_asked - ledger.requests <= 1
            with command(tmp_path, *arguments, "--resume") as running:
                assert running.wait() == 0, running.text
        record = record_in(run_dir(tmp_path))
    use, tokens = used_in(record)
    assert record.outcome.status == "completed"
    assert use.requests is not None
    # At most the request in flight is lost.
    assert api.n_asked - 1 <= use.requests <= api.n_asked
    assert tokens.input_noncached >= (api.n_asked - 2) * (INPUT - CACHED)


def kill(running: Command, victim: str) -> None:
    if victim == "everything":
        running.kill_all()
    elif victim == "command":
        running.kill()
    else:
        words = b"agent_supervisor.supervisor" if victim == "supervisor" else b"evopolicy_gateway.relay\0"
        assert running.kill_below(words), f"no {victim} runs"


def test_a_run_is_recorded_whole_and_stamped(tmp_path: Path, operator: Path) -> None:
    arguments = ["--record-model", "full"]
    read = Step(command="cat AGENTS.md; env; echo sk-0123456789abcdefghij")
    with ModelApi([read, *ENDS]) as api:
        given = [*run_arguments(operator, llm_agent(tmp_path, api.base_url)), *arguments]
        with command(tmp_path, *given) as running:
            assert running.wait() == 0, running.text
    root = run_dir(tmp_path)
    use, _ = used_in(record_in(root))
    calls = model_record.read_calls(root / model_record.FOLDER)
    assert (use.record, use.record_stopped, use.requests) == ("full", "", len(calls))
    with contextlib.closing(model_record.Pack(root / model_record.FOLDER)) as pack:
        held = b"\n".join(map(pack.get, pack.keys()))
    assert b"[token-0]/submit" in held
    assert b"sk-0123456789abcdefghij" not in held


LUCK = """
import random
class Policy:
    def __init__(self, *about): pass
    def reset(self, episode_index): pass
    def act(self, obs): return [random.uniform(-1, 1)]
"""
EDIT = Step(command=f"echo '{LUCK}' > system/policy.py; pwd; date; ls -l; cat AGENTS.md feedback/*/*")


@pytest.mark.parametrize("api_name", ["chat", "messages"])
def test_a_recorded_agent_replays_to_the_byte_without_its_model(
    tmp_path: Path, operator: Path, api_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: hands over a run directory that names programs, which `evopolicy replay` would run. Defence:
    `.replay.json` has an authentication code by a key of the user; without it, `--trust` is needed."""
    script = [EDIT, SUBMIT, EDIT, Step(odd=odd_answers.busy(429, retry_after="0")), *ENDS[1:]]
    with ModelApi(script) as api:
        arguments = run_arguments(operator, llm_agent(tmp_path, api.base_url, api_name))
        with command(tmp_path, *arguments, "--record-model", "full") as running:
            assert running.wait() == 0, running.text
    monkeypatch.delenv("MODEL_ACCESS")
    (tmp_path / "agent.toml").unlink()
    again = ["replay", str(run_dir(tmp_path)), "--credentials", str(operator)]
    with command(tmp_path, *again) as running:
        assert running.finish()[:2] == (0, "identical\n"), running.text
    (other,) = (tmp_path / "replayed").glob("*/toy_line/t")
    assert record_in(other).outcome == record_in(run_dir(tmp_path)).outcome
    assert record_in(other).replay_of == record_in(run_dir(tmp_path)).run
    # The same agent with another system prompt: its first request is another one.
    kept = run_dir(tmp_path) / ".replay.json"
    document = json.loads(kept.read_bytes())
    document["plan"]["config"]["api"]["system"] = "You are somebody else."
    kept.write_text(json.dumps(document))
    # The file names programs that a replay runs: one that was changed, or made by others, is not trusted.
    with command(tmp_path, *again) as running:
        assert running.finish()[0] == 2
        assert "was not recorded by you on this machine" in running.text
    with command(tmp_path, *again, "--trust") as running:
        code, out, _ = running.finish()
    assert code == 1
    assert out.startswith("request 0 to ")
    assert "+" in out
    assert "You are somebody else." in out


@pytest.mark.parametrize(
    "api_name", ["responses", "gemini", pytest.param("messages", marks=pytest.mark.system)]
)
def test_a_run_with_reasoning_replays_to_the_byte_over_each_api(
    tmp_path: Path, operator: Path, api_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = [EDIT.command or "", SUBMIT.command or ""] * 3
    script = [Said(commands=(each, "ls"), reasoning=f"thought {n}") for n, each in enumerate(commands)]
    with ProviderApi(api_name, script) as api:
        agent = llm_agent(tmp_path, api.base_url.removesuffix("/v1"), api_name)
        with command(tmp_path, *run_arguments(operator, agent), "--record-model", "full") as running:
            assert running.wait() == 0, running.text
    use, tokens = used_in(record_in(run_dir(tmp_path)))
    assert (use.requests, use.requests_failed) == (len(api.requests), 0)
    # The relay's counts, the agent's own, and the server's are the same.
    assert use.reported == msgspec.structs.replace(tokens, reasoning=None)
    assert (tokens.input_noncached, tokens.output) == (api.n_answered * FRESH, api.n_answered * ANSWERED)
    monkeypatch.delenv("MODEL_ACCESS")
    again = ["replay", str(run_dir(tmp_path)), "--credentials", str(operator)]
    with command(tmp_path, *again) as running:
        assert running.finish()[:2] == (0, "identical\n"), running.text
