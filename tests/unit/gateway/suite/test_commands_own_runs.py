"""The runs of `evopolicy local` and `evopolicy run`, without a sweep's folder."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import pytest
from stages.sweep_stage import Direct, until

from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_gateway.suite import runs


def test_a_failing_run_stops_no_other_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)

    async def act(name: str) -> None:
        if name == "toy/line":
            raise EvopolicyError("the gateway cannot serve")

    direct.act = act
    failed, completed = runs.documents(direct.play())
    assert (failed["status"], failed["error"]) == ("error", "the gateway cannot serve")
    assert (completed["status"], completed["final_score"]) == ("completed", 1.0)
    assert direct.output.getvalue() == "toy/line: failed: the gateway cannot serve\n"
    assert not list(tmp_path.glob("**/suite.json"))


def test_a_wrong_option_of_all_runs_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)
    wrong = {"toy/line"}

    async def act(name: str) -> None:
        if name in wrong:
            raise ConfigError(f"{name} has too few cases")

    direct.act = act
    documents = runs.documents(direct.play())
    assert [one["wrong_option"] for one in documents] == [True, False]
    wrong.add("toy/maze")
    with pytest.raises(ConfigError, match="toy/line has too few cases"):
        direct.play()
    assert direct.output.getvalue() == ""


def test_a_commands_own_runs_continue_when_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)
    direct.plans[1] = msgspec.structs.replace(direct.plans[1], resume=True)

    async def act(name: str) -> None:
        await until(lambda: len(direct.kinds) == 2)
        if name == "toy/line":
            raise KeyboardInterrupt
        await asyncio.Event().wait()

    direct.act = act
    with pytest.raises(KeyboardInterrupt):
        direct.play(parallel=2)
    assert direct.kinds == ["play", "go_on"]
    assert direct.ended == ["toy/line", "toy/maze"]
