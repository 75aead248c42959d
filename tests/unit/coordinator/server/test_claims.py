"""Claims of a sweep's runs: one holder at a time, across restarts of everyone."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages.operator import Claim
from evopolicy_coordinator.server.claims import ClaimTable
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.storage.writer import Writer


@contextlib.asynccontextmanager
async def claims_in(path: Path) -> AsyncIterator[ClaimTable]:
    store = Store(path / "store.db")
    writer = Writer(store)
    try:
        yield ClaimTable(writer)
    finally:
        await writer.close()
        store.close()


def claim(holder: str, ttl_s: float = 60.0, name: str = "a/env/0", **more: Any) -> Claim:
    return Claim(token="", suite="s", name=name, holder=holder, ttl_s=ttl_s, **more)


async def test_a_held_claim_is_exclusive_until_its_time_is_up(tmp_path: Path) -> None:
    async with claims_in(tmp_path) as claims:
        assert (await claims.answer_claim(claim("one"), 0.0)).granted
        refused = await claims.answer_claim(claim("two"), 59.0)
        assert (refused.granted, refused.holder, refused.run, refused.kept) == (False, "one", "", False)
        again = await claims.answer_claim(claim("one", run="r-1"), 59.0)
        assert (again.granted, again.kept) == (True, True)
        assert not (await claims.answer_claim(claim("two"), 118.0)).granted
        taken = await claims.answer_claim(claim("two"), 120.0)
        assert (taken.granted, taken.previous, taken.run) == (True, "one", "r-1")
        assert not (await claims.answer_claim(claim("one"), 121.0)).granted


async def test_a_settled_claim_is_settled_for_good(tmp_path: Path) -> None:
    async with claims_in(tmp_path) as claims:
        await claims.answer_claim(claim("one"), 0.0)
        await claims.answer_claim(claim("one", result={"status": "completed"}), 1.0)
        late = await claims.answer_claim(claim("two"), 1e6)
        assert (late.granted, late.holder, late.result) == (False, "one", {"status": "completed"})


async def test_a_result_settles_a_claim_that_another_host_holds(tmp_path: Path) -> None:
    async with claims_in(tmp_path) as claims:
        # As of a coordinator on a backup from before the run: it grants the finished run once more.
        began = await claims.answer_claim(claim("two", run="r-2"), 0.0)
        offered = await claims.answer_claim(claim("one", result={"status": "completed"}), 1.0)
        assert (offered.granted, offered.run, offered.coordinator) == (True, "r-2", began.coordinator)
        late = await claims.answer_claim(claim("two", run="r-2"), 2.0)
        assert (late.granted, late.holder, late.result) == (False, "one", {"status": "completed"})


async def test_a_claim_that_was_given_back_is_free(tmp_path: Path) -> None:
    async with claims_in(tmp_path) as claims:
        await claims.answer_claim(claim("one"), 0.0)
        assert not (await claims.answer_claim(claim("one", ttl_s=0.0), 1.0)).granted
        assert (await claims.answer_claim(claim("two"), 2.0)).granted


async def test_only_one_of_many_that_ask_at_once_gets_it(tmp_path: Path) -> None:
    async with claims_in(tmp_path) as claims:
        answers = await asyncio.gather(*(claims.answer_claim(claim(f"host-{n}"), 0.0) for n in range(20)))
        assert sum(answer.granted for answer in answers) == 1


async def test_a_restarted_coordinator_knows_the_holders_and_gives_them_their_time_anew(
    tmp_path: Path,
) -> None:
    async with claims_in(tmp_path) as claims:
        await claims.answer_claim(claim("one", run="r-1"), 0.0)
        await claims.answer_claim(claim("one", name="b"), 0.0)
        await claims.answer_claim(claim("one", name="b", result={"n": 1}), 0.0)
    async with claims_in(tmp_path) as claims:
        assert not (await claims.answer_claim(claim("two"), 1000.0)).granted
        assert not (await claims.answer_claim(claim("two"), 1059.0)).granted
        assert (await claims.answer_claim(claim("two"), 1060.0)).run == "r-1"
        assert (await claims.answer_claim(claim("two", name="b"), 1060.0)).result == {"n": 1}


@pytest.mark.parametrize("ttl_s", [-1.0, float("nan"), float("inf"), 1e9])
async def test_times_that_mean_nothing_are_refused(tmp_path: Path, ttl_s: float) -> None:
    async with claims_in(tmp_path) as claims:
        with pytest.raises(RefusedError):
            await claims.answer_claim(claim("one", ttl_s=ttl_s), 0.0)
