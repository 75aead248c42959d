"""The outbox: effects in order, none before what it rests on is durable, and many of them for one fsync."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rigs.store_rows import run_row

from evopolicy_common.errors import StorageError
from evopolicy_coordinator.core.contract.effects import Effect, Log, Persist
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.storage.writer import EffectQueue, Writer


def persist(number: int) -> Persist:
    return Persist(rows=(run_row(f"r-{number}"),))


def tell(number: int) -> Log:
    return Log(level="info", event=str(number), fields={})


class World:
    """A store whose writes can be held up, and what came out of an outbox on it."""

    def __init__(self, path: Path) -> None:
        self.store = Store(path)
        self.gate = threading.Event()
        self.gate.set()
        self.writer = Writer(self.store)
        self.out: list[Effect] = []
        self.failures: list[BaseException] = []
        self.durable_when_out: list[set[str]] = []
        self.outbox = EffectQueue(self.writer, self._carry_out, self.failures.append)

    def _carry_out(self, effect: Effect) -> None:
        self.out.append(effect)
        self.durable_when_out.append(self.runs())

    def runs(self) -> set[str]:
        return {run for (run,) in self.store._db.execute("SELECT run FROM runs")}

    def hold(self) -> None:
        """The writer's thread waits until the gate opens."""
        self.gate.clear()
        self.writer.call(lambda store: self.gate.wait(10))

    async def settle(self) -> None:
        while not self.outbox.idle and not self.failures:
            await self.writer.call(lambda store: None)

    async def close(self) -> None:
        self.gate.set()
        await self.writer.close()
        self.store.close()


@contextlib.asynccontextmanager
async def world_at(path: Path) -> AsyncIterator[World]:
    """All that is put out is carried out at the end."""
    world = World(path)
    try:
        yield world
        await world.settle()
    finally:
        await world.close()


async def test_effect_behind_a_persist_waits_until_it_is_durable(tmp_path: Path) -> None:
    async with world_at(tmp_path / "db") as world:
        world.hold()
        world.outbox.put([tell(0), persist(1), tell(1)])
        world.outbox.flush()
        assert world.out == [tell(0)]
        world.gate.set()
        await world.settle()
        assert world.out == [tell(0), tell(1)]
        assert world.durable_when_out[1] == {"r-1"}


async def test_what_comes_while_a_write_is_under_way_shares_the_next_one(tmp_path: Path) -> None:
    async with world_at(tmp_path / "db") as world:
        world.hold()
        for number in range(100):
            world.outbox.put([persist(number), tell(number)])
            world.outbox.flush()
        world.gate.set()
    assert world.out == [tell(number) for number in range(100)]
    assert world.outbox.commits == 2


async def test_failed_write_stops_everything_behind_it(tmp_path: Path) -> None:
    async with world_at(tmp_path / "db") as world:
        world.outbox.put([persist(0), tell(0)])
        world.outbox.flush()
        await world.settle()
        clash = Persist(rows=(run_row("r-1"), run_row("r-2", key="key-r-0")))
        world.outbox.put([clash, tell(1), persist(3), tell(3)])
        world.outbox.flush()
        await world.settle()
        world.outbox.put([tell(4)])
        world.outbox.flush()
        assert world.out == [tell(0)]
        assert len(world.failures) == 1
        assert world.runs() == {"r-0"}


async def test_a_bug_in_a_write_is_reported_and_the_thread_goes_on(tmp_path: Path) -> None:
    def breaks(store: Store) -> None:
        raise LookupError("a bug")

    async with world_at(tmp_path / "db") as world:
        world.outbox.put([Persist(rows=(object(),)), tell(0)])  # type: ignore[arg-type]
        world.outbox.flush()
        await world.settle()
        assert world.out == []
        assert len(world.failures) == 1
        assert not isinstance(world.failures[0], StorageError)
        with pytest.raises(LookupError, match="a bug"):
            await world.writer.call(breaks)
        assert await world.writer.call(lambda store: 7) == 7


async def test_discarded_outbox_carries_out_nothing_more(tmp_path: Path) -> None:
    world = World(tmp_path / "db")
    world.hold()
    world.outbox.put([persist(0), tell(0)])
    world.outbox.flush()
    world.outbox.discard()
    world.gate.set()
    await world.writer.call(lambda store: None)
    assert world.out == []
    assert world.failures == []
    await world.close()


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(ticks=st.lists(st.lists(st.booleans(), max_size=6), max_size=8), data=st.data())
def test_effects_come_out_in_order_and_never_ahead_of_their_rows(
    tmp_path_factory: pytest.TempPathFactory, ticks: list[list[bool]], data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("outbox") / "db"
    effects: list[Effect] = []

    async def scenario() -> World:
        async with world_at(path) as world:
            for tick in ticks:
                made = [(persist if durable else tell)(len(effects) + i) for i, durable in enumerate(tick)]
                effects.extend(made)
                world.outbox.put(made)
                world.outbox.flush()
                if data.draw(st.booleans()):
                    await asyncio.sleep(0)
        return world

    world = asyncio.run(scenario())
    assert world.out == [effect for effect in effects if isinstance(effect, Log)]
    for effect, durable in zip(world.out, world.durable_when_out, strict=True):
        needed = {
            row.run
            for earlier in effects[: effects.index(effect)]
            if isinstance(earlier, Persist)
            for row in earlier.rows
        }
        assert needed <= durable
