"""How long commands on finished runs wait for a worker that offers a run's environment."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import DescribeEnvironment, EnvironmentState, Evaluate
from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_results import evaluations
from evopolicy_results.evaluations import Evaluations
from evopolicy_results.publish import replay
from evopolicy_results.rescore import play

LINK = cast(Any, SimpleNamespace(credentials=SimpleNamespace(token="", cluster="local")))


class Cluster:
    """A cluster whose worker could not describe the environment, or did not start."""

    own = True

    def __init__(self, knows_run: bool = True) -> None:
        self.knows_run = knows_run
        self.closed = False
        self.failed: dict[str, dict[str, str]] = {}

    async def describe(self, message: DescribeEnvironment) -> EnvironmentState:
        return EnvironmentState(split_hashes={}, knows_run=self.knows_run, fingerprints=())

    async def environments(self) -> tuple[list[Any], dict[str, Any], dict[str, dict[str, str]]]:
        return [], {}, self.failed

    async def evaluate(self, message: object) -> AsyncGenerator[tuple[None, int, str], None]:
        try:
            for n in range(3):
                yield None, n, "a worker that offers it"
        finally:
            self.closed = True


def soon(work: Coroutine[Any, Any, Any]) -> Any:
    return asyncio.run(cast(Any, asyncio.wait_for(work, 30)))


def class_of(own: bool, cluster: Cluster, record: RunRecord) -> Any:
    client = Evaluations(LINK, lambda count, waits_for: None, own=own)
    cluster.own = own
    client.ask = cast(Any, cluster)
    return soon(play.class_of(record, client))


def test_a_check_waits_for_no_worker_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluations, "DESCRIPTION_S", 0.2)
    env = "miniwob/click-test-v1"
    run = SimpleNamespace(
        opening=SimpleNamespace(settings=SimpleNamespace(env=env)),
        record=SimpleNamespace(versions=SimpleNamespace(fingerprint={})),
    )
    client = Evaluations(LINK, lambda count, waits_for: None)
    client.ask = cast(Any, Cluster())
    why_not, _ = soon(replay.unplayable(client, cast(Any, run)))
    assert "no worker" in why_not
    assert f"check-env {env}" in why_not
    client.ask.failed = {env: {"w": "it raised in its 3rd step"}}  # type: ignore[attr-defined]
    assert soon(replay.unplayable(client, cast(Any, run))) == ("it raised in its 3rd step", False)


@pytest.mark.parametrize(("own", "remedy"), [(True, "check-env gym/acrobot"), (False, "--env gym/acrobot")])
def test_a_re_score_waits_for_no_worker_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool, remedy: str
) -> None:
    monkeypatch.setattr(evaluations, "DESCRIPTION_S", 0.5)
    folder = write_run(tmp_path, [Version(policy(gain=1.0), (1.0,), 1.0)], env="gym/acrobot")
    record = decode_run_record((folder / "run.json").read_bytes())
    with pytest.raises(ConfigError, match=remedy):
        class_of(own, Cluster(), record)


def test_a_run_that_the_coordinator_does_not_know_is_not_waited_for(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [Version(policy(gain=1.0), (1.0,), 1.0)])
    record = decode_run_record((folder / "run.json").read_bytes())
    with pytest.raises(ConfigError, match="no finished run"):
        class_of(True, Cluster(knows_run=False), msgspec.structs.replace(record, run="r"))


def test_progress_names_the_reason_for_waiting_until_the_evaluation_ends() -> None:
    told: list[tuple[int, str]] = []
    client = Evaluations(LINK, lambda count, waits_for: told.append((count, waits_for)))
    client.ask = cast(Any, cluster := Cluster())

    async def play_all() -> int:
        message = Evaluate(token="", key="k", env="toy/line", bundle=None, split="train", cases=None)
        return len([outcome async for outcome in client.outcomes(message)])

    assert soon(play_all()) == 0
    assert told == [(0, "a worker that offers it")] * 3
    assert cluster.closed
