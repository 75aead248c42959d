"""The client of agents reads a gateway's answers: verdicts, refusals, and none at all."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from stages.agent_fakes import FakeGateway, serving

from evopolicy_gateway.agents.client import ChargedSubmit, Client, GatewayError, RefusedSubmit

BOX = {"type": "Box", "shape": [1], "dtype": "float32", "low": [-1.0], "high": [1.0]}

POLICY = """class Policy:
    def __init__(self, *about):
        pass

    def reset(self, episode_index):
        pass
"""


def a_gateway(workspace: Path, **options: Any) -> FakeGateway:
    (workspace / "system").mkdir()
    (workspace / "system" / "policy.py").write_text(POLICY)
    return FakeGateway(
        workspace=workspace,
        obs_space=BOX,
        action_space=BOX,
        play=lambda policy, case: (float(case), []),
        budget=10,
        **options,
    )


def a_client(url: str, **options: Any) -> Client:
    """A client with a clock that only sleeping moves."""
    slept = [0.0]
    urls = {f"{name}_url": f"{url}/{name}" for name in ("info", "task", "submit")}
    return Client(**urls, sleep=slept.append, clock=lambda: sum(slept), **options)


def test_submit_is_asked_for_until_its_summary_is_there(tmp_path: Path) -> None:
    with serving(a_gateway(tmp_path)) as gateway:
        verdict = a_client(gateway.url).submit([3, 4])
        assert isinstance(verdict, ChargedSubmit)
        assert verdict.name == "submit_000"
        assert verdict.summary["returns"] == [3.0, 4.0]
        assert gateway.n_asked == 2


@pytest.mark.parametrize("first", [(409, {"error": {"message": "submit_000 runs"}}), (503, {})])
def test_a_submit_is_sent_again_until_it_is_taken_once(
    first: tuple[int, dict[str, Any]], tmp_path: Path
) -> None:
    with serving(a_gateway(tmp_path, script=[first, first])) as gateway:
        assert isinstance(a_client(gateway.url).submit([0]), ChargedSubmit)
        assert len(gateway.submits) == 1


@pytest.mark.parametrize("status", ["run_closed", "cancelled"])
def test_a_run_that_takes_no_more_ends_the_asking(tmp_path: Path, status: str) -> None:
    over = (409, {"status": status, "error": {"message": "no more submits are taken"}})
    with serving(a_gateway(tmp_path, script=[over])) as gateway:
        refusal = a_client(gateway.url).submit([0])
        assert refusal == RefusedSubmit(status=status, message="no more submits are taken")


def test_refused_submit_tells_status_and_message(tmp_path: Path) -> None:
    with serving(a_gateway(tmp_path)) as gateway:
        refusal = a_client(gateway.url).submit(list(range(11)))
        assert refusal == RefusedSubmit(status="budget_invalid", message="11 episodes, 10 left")


def test_task_is_read_as_text(tmp_path: Path) -> None:
    with serving(a_gateway(tmp_path)) as gateway:
        assert a_client(gateway.url).task() == "# Task"


def test_a_gateway_that_stays_away_is_given_up_after_the_timeout() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        client = a_client(f"http://127.0.0.1:{unused.getsockname()[1]}", timeout_s=5.0)
        with pytest.raises(GatewayError, match="did not answer for 5 s"):
            client.info()


def test_urls_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("INFO", "TASK", "SUBMIT"):
        monkeypatch.setenv(f"EVOPOLICYGYM_{name}_URL", f"http://127.0.0.1:1/token/{name.lower()}")
    client = Client.from_environment()
    assert client.submit_url == "http://127.0.0.1:1/token/submit"
