"""Runs whose processes are killed at random instants: what is recorded of the model is what its API has
counted, and a run that is being replayed does not change."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import command, record_in, run_arguments, run_dir, toy_cluster
from stages.model_api import CACHED, OUTPUT, ModelApi, Step, llm_agent
from waiting import wait_until

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]

SUBMIT = Step(command="curl -s -X POST -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL")
VICTIMS = {
    "relay": b"evopolicy_gateway.relay\0",
    "gateway": b"evopolicy_gateway.cli.serve\0",
    "supervisor": b"evopolicy_gateway.agent_supervisor.supervisor",
}
"""Part of the command line by victim."""
N_KILLS = 6


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with toy_cluster(tmp_path_factory.mktemp("cluster")) as file:
        yield file


@pytest.mark.parametrize(("seed", "end"), [(0, "completed"), (1, "completed"), (2, "cancelled")])
def test_kills_at_random_lose_at_most_the_requests_in_flight(
    tmp_path: Path, operator: Path, monkeypatch: pytest.MonkeyPatch, seed: int, end: str
) -> None:
    chance = random.Random(f"{seed} {end}")
    monkeypatch.setenv("MODEL_ACCESS", "key-of-the-test-0123456789")
    # Each answer in flight may be lost, and its step with it: there are more steps than a run without kills
    # needs.
    script = [*[Step(command=f"sleep 0.0{n % 4}") for n in range(40)], *[SUBMIT] * 20]
    lost = 0
    with ModelApi(script) as api, contextlib.ExitStack() as stack:
        arguments = run_arguments(operator, llm_agent(tmp_path, api.base_url, retries=50))
        running = stack.enter_context(command(tmp_path, *arguments))
        for _ in range(N_KILLS):
            wanted = api.n_asked + chance.randint(1, 3)
            wait_until(lambda wanted=wanted: api.n_asked >= wanted)
            time.sleep(chance.random() * 0.1)
            victim = chance.choice([*VICTIMS, *VICTIMS, "command", "everything"])
            if victim in VICTIMS:
                lost += running.kill_below(VICTIMS[victim]) and victim == "relay"
                continue
            running.kill_all() if victim == "everything" else running.kill()
            lost += 1
            running = stack.enter_context(command(tmp_path, *arguments, "--resume"))
        if end == "cancelled":
            wanted = api.n_asked + 2
            wait_until(lambda: api.n_asked >= wanted)
            running.process.send_signal(signal.SIGINT)
        running.wait()
        record = record_in(run_dir(tmp_path))
        n_asked, n_answered = api.n_asked, api.n_answered
    use, tokens = record.agent.model_use, record.agent.tokens
    assert record.outcome.status == end, running.text
    assert use is not None
    assert use.requests is not None
    assert tokens is not None
    assert n_asked - lost <= use.requests <= n_asked
    # Requests that reached the API, but whose agent was killed before their end, are counted without tokens
    # or with some.
    whole = use.requests - use.requests_failed
    assert whole <= n_answered <= n_asked
    assert whole * CACHED <= tokens.cache_read <= n_answered * CACHED
    assert whole * OUTPUT <= tokens.output <= n_answered * OUTPUT
    assert record.agent.model_string == "m-1"


@pytest.mark.parametrize("seed", range(int(os.environ.get("EVOPOLICY_KILL_SEEDS", "1"))))
def test_kills_during_a_replay_leave_the_recorded_run_as_it_was(
    tmp_path: Path, operator: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    chance = random.Random(f"replay {seed}")
    monkeypatch.setenv("MODEL_ACCESS", "key-of-the-test-0123456789")
    with ModelApi([Step(command="sleep 0.1; ls"), SUBMIT] * 3) as api:
        arguments = [
            *run_arguments(operator, llm_agent(tmp_path, api.base_url, retries=50)),
            "--record-model",
            "full",
        ]
        with command(tmp_path, *arguments) as running:
            assert running.wait() == 0, running.text
    recorded = _content(run_dir(tmp_path))
    again = ["replay", str(run_dir(tmp_path)), "--credentials", str(operator)]
    for victim in [*VICTIMS, "command", "everything"]:
        with command(tmp_path, *again) as running:
            time.sleep(chance.random() * 3)
            if victim in VICTIMS:
                running.kill_below(VICTIMS[victim])
                code, text = running.wait(), running.text
                assert code in (0, 1), text
            else:
                running.kill_all() if victim == "everything" else running.kill()
        assert running.alive() == []
        assert _content(run_dir(tmp_path)) == recorded
        with command(tmp_path, *again) as running:
            assert running.finish()[:2] == (0, "identical\n"), running.text


def _content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
