"""Whatever a gateway asks of a run that takes no more, it is refused with a word that says so, or answered."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from coordinator_harness import Coordinator, GatewayClient, bundle_of, gateway_of, operator_of, working

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import gateway, operator
from evopolicy_common.refusals import RUN_OVER, Refusal

WORDS = {"closed": Refusal.RUN_CLOSED, "finished": Refusal.RUN_FINISHED, "cancelled": Refusal.RUN_CANCELLED}


@pytest.mark.parametrize("end", WORDS)
async def test_every_refusal_to_an_ended_runs_gateway_says_so(tmp_path: Path, end: str) -> None:
    coordinator = Coordinator(tmp_path / "state")
    try:
        async with operator_of(coordinator) as asking:
            created = await asking.create("key", n_validation=1, n_heldout=1)
            async with gateway_of(coordinator, created) as client:
                await ended(coordinator, client, created.run, end)
                found = await refusals(client)
        assert found == {"upload": WORDS[end], "submit": WORDS[end]} | (
            {} if end == "closed" else {"open": WORDS[end]}
        )
        assert set(found.values()) <= RUN_OVER
        coordinator.kill()
        coordinator = Coordinator(tmp_path / "state")
        async with gateway_of(coordinator, created) as client:
            after = await refusals(client)
            # A coordinator that was started again asks for the bundle first, whose upload it then refuses.
            assert after.pop("submit") in (WORDS[end], Refusal.MISSING_BUNDLE)
            assert {**after, "submit": WORDS[end]} == found
            assert (await client.state()).cancelled == (end == "cancelled")
    finally:
        coordinator.kill()


async def ended(coordinator: Coordinator, client: GatewayClient, run: str, end: str) -> None:
    async with operator_of(coordinator) as asking, working(coordinator, "w") as worker:
        await client.submit(bundle_of("# first"), (0,), "first")
        await client.results(0)
        if end == "cancelled":
            worker.hold.clear()
            await client.submit(bundle_of("# second"), (0, 1), "second")
            waiting = asyncio.create_task(client.results(1))
            await asyncio.sleep(0.1)
            message = operator.CancelRun(token=asking.token, run=run)
            await asking.ask.until_answered("cancel", message, operator.Done)
            episodes, done = await waiting
            assert (episodes, done.status, done.n_episodes) == ([], "cancelled", 0)
            assert done.remaining_budget == (await client.state()).remaining_budget == 15
        else:
            worker.hold.set() if end == "finished" else worker.hold.clear()
            await client.close()
            if end == "finished":
                await asking.finished(run)


async def refusals(client: GatewayClient) -> dict[str, Refusal]:
    """Which requests are refused, and with which word."""
    own = {"run": client.run, "token": client.token}
    late = bundle_of("# late")
    asked = {
        "open": client.ask.once("open", gateway.OpenRun(**own), gateway.RunOpened),
        "state": client.ask.once("state", gateway.StateRequest(**own), gateway.RunState),
        "upload": client.ask.upload(client.run, client.token, late.digest, late.packed),
        "submit": client.submit_digest(bundle_of("# first").digest, (0,), "late"),
        "results": client.results(0),
        "close": client.close(),
    }
    found = {}
    for name, request in asked.items():
        try:
            await request
        except RefusedError as error:
            found[name] = error.status
    return found
