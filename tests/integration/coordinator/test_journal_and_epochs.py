"""A coordinator's journal over the wire: commitments, disclosure, a new epoch, and the commands that tell of it."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import pytest
from coordinator_harness import Coordinator, GatewayClient, bundle_of, gateway_of, operator_of, working
from coordinator_harness import OperatorClient as HarnessOperator

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.records import journal
from evopolicy_common.wire.operator_client import OperatorClient
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.storage.backup import back_up
from evopolicy_results.publish.contents import signed_by

pytestmark = pytest.mark.system


def command(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "evopolicy_coordinator.cli", *args], capture_output=True, text=True, timeout=60
    )


def listed(state: Path) -> dict[str, object]:
    document: dict[str, object] = json.loads(command("epoch", "list", "--state", str(state), "--json").stdout)
    return document


async def play(coordinator: Coordinator, operator: HarnessOperator, key: str) -> RunFinished:
    created = await operator.create(key)
    async with gateway_of(coordinator, created) as gateway:
        await _submit(gateway)
        await gateway.close()
    return await operator.finished(created.run)


async def _submit(gateway: GatewayClient) -> None:
    await gateway.open()
    await gateway.submit(bundle_of("# a policy"), (0, 1), "submit")
    await gateway.results(0)


def test_runs_are_committed_to_disclosed_and_followed_by_another_epoch(tmp_path: Path) -> None:
    state = tmp_path / "state"

    async def first() -> str:
        async with operator_of(coordinator) as operator, working(coordinator):
            finished = await play(coordinator, operator, "one")
            left = await operator.create("left open")
            place = finished.committed
            assert place is not None
            async with connect(coordinator.credentials("operator")) as link:
                client = OperatorClient(link)
                with pytest.raises(RefusedError, match="not disclosed"):
                    await client.opening(finished.run)
                with pytest.raises(RefusedError, match="is not finished"):
                    await client.disclose((finished.run,))
                await client.cancel(left.run)
                await client.disclose((finished.run,))
                entries = await client.journal()
                heads = journal.heads(entries)
                kinds = [type(journal.read_entry(entry)).__name__ for entry in entries]
                assert kinds == ["Opened", "Ended", "Opened", "Ended", "Revealed"]
                assert (heads[place.opened], place.ended) == (place.opened_head, 1)
                opening = await client.opening(finished.run)
                assert journal.commitment(opening.salt, opening.opening) == place.commitment
                ended = journal.read_entry(entries[1])
                assert isinstance(ended, journal.Ended)
                assert ended.result == journal.digest(opening.result)
                signed = await client.sign(heads[-1])
                assert signed_by(signed.key, signed.signature, heads[-1])
                assert not signed_by(signed.key, signed.signature, heads[0])
                with pytest.raises(RefusedError, match="epoch new"):
                    await operator.create("on public cases")
            return signed.key

    coordinator = Coordinator(state)
    try:
        key = asyncio.run(asyncio.wait_for(first(), 120))
        busy = command("epoch", "new", "--state", str(state))
        assert (busy.returncode, "in use" in busy.stderr) == (2, True)
    finally:
        coordinator.stop()
    assert command("identity", "--state", str(state)).stdout.strip() == key
    before = listed(state)
    assert command("epoch", "new", "--state", str(state)).returncode == 0
    assert "(current)  0     0         none yet" in command("epoch", "list", "--state", str(state)).stdout
    back_up(state, tmp_path / "backup")

    async def second() -> RunFinished:
        async with operator_of(coordinator) as operator, working(coordinator):
            return await play(coordinator, operator, "on new cases")

    coordinator = Coordinator(state)
    try:
        finished = asyncio.run(asyncio.wait_for(second(), 120))
    finally:
        coordinator.stop()
    after = listed(state)
    assert finished.committed is not None
    assert finished.committed.epoch == after["current"] != before["current"]
    assert [each["revealed_at"] is None for each in after["epochs"]] == [False, True]  # type: ignore[attr-defined]
    assert listed(tmp_path / "backup")["head"] == before["head"]
    assert command("identity", "--state", str(tmp_path / "backup")).stdout.strip() == key
