"""How long a check of published results waits for a worker that offers a run's environment."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from evopolicy_results.publish import replay


class NobodyOffers:
    """A cluster whose worker could not describe the environment, or did not start."""

    async def evaluate(self, message: object) -> AsyncGenerator[tuple[None, int, str], None]:
        while True:
            await asyncio.sleep(0.01)
            yield None, 1, "a worker that offers it"

    async def environments(self) -> tuple[list[Any], dict[str, Any]]:
        return [], {}


def test_an_environment_that_no_worker_offers_is_not_waited_for_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(replay, "DESCRIPTION_S", 0.2)
    env = "miniwob/click-test-v1"
    run = cast(
        Any,
        SimpleNamespace(
            opening=SimpleNamespace(settings=SimpleNamespace(env=env)),
            record=SimpleNamespace(versions=SimpleNamespace(fingerprint={})),
        ),
    )
    ended = asyncio.wait_for(replay.unplayable(cast(Any, NobodyOffers()), run), 30)
    why_not, _ = asyncio.run(cast(Any, ended))
    assert "no worker" in why_not
    assert f"check-env {env}" in why_not
