"""How long a re-score waits for a worker that offers the run's environment."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import DescribeEnvironment, EnvironmentState
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_results.rescore import play

WANTED = play.Wanted(name="more", n_cases=1, data=None, every=False)


class NobodyDescribes:
    """A cluster whose worker could not describe the environment."""

    async def describe(self, message: DescribeEnvironment) -> EnvironmentState:
        return EnvironmentState(split_hashes={}, knows_run=True, fingerprints=())


@pytest.mark.parametrize(("own", "remedy"), [(True, "check-env gym/acrobot"), (False, "--env gym/acrobot")])
def test_an_environment_that_no_worker_can_describe_ends_the_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool, remedy: str
) -> None:
    monkeypatch.setattr(play, "DESCRIPTION_S", 0.5)
    folder = write_run(tmp_path, [Version(policy(gain=1.0), (1.0,), 1.0)], env="gym/acrobot")
    record = decode_run_record((folder / "run.json").read_bytes())
    link = cast(Any, SimpleNamespace(credentials=SimpleNamespace(token="", cluster="local")))
    rescorer = play.Rescorer(link, WANTED, lambda came, waits_for: None, own_workers=own)
    rescorer._ask = cast(Any, NobodyDescribes())
    with pytest.raises(ConfigError, match=remedy):
        asyncio.run(asyncio.wait_for(rescorer._class(record), 30))
