"""Runs that play another one again: its cases and its secret are given to its own operator, once it is over.

Attacks, each with its defence:
- opens a run as a replay, to get another run's hidden cases and random seeds, or to hide a run from the count
  of runs: only the operator with the run's key, after the run's end, with the same settings; marked in the
  journal, and never published or in a report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.service_world import World, started

from evopolicy_common.messages import operator
from evopolicy_common.messages.worker import Refused
from evopolicy_common.records import journal
from evopolicy_coordinator.core.contract.records import JournalRow, RunRow
from evopolicy_coordinator.storage.store import rows

OWN = {"hidden_cases": "per_run"}


async def create(world: World, key: str, proof: str = "", **settings: Any) -> Any:
    return await world.answer(world.creating(key, proof=proof, **OWN | settings))


async def cancel(world: World, run: str) -> None:
    assert isinstance(await world.answer(world.cancelling(run)), operator.Done)


def row(world: World, run: str) -> RunRow:
    return next(each for each in rows(world.store._db, RunRow) if each.run == run)


async def test_a_replay_has_secret_and_cases_of_its_run_and_is_marked(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        first = await create(world, "first")
        await cancel(world, first.run)
        again = await create(world, "again", "first", replay_of=first.run)
        stranger = await create(world, "stranger")
        assert (await create(world, "again", "first", replay_of=first.run)) == again
        original, replay, other = (row(world, each.run) for each in (first, again, stranger))
        for name in ("secret", "train", "validation", "heldout", "split_hashes", "epoch", "max_steps"):
            assert getattr(replay, name) == getattr(original, name), name
        assert replay.settings == msgspec.structs.replace(original.settings, replay_of=first.run)
        for name in ("run", "key", "capability", "salt"):
            assert getattr(replay, name) != getattr(original, name), name
        assert other.secret != original.secret
        assert other.heldout != original.heldout
        # Related to all that its run is related to; the stranger is not.
        core = world.service.host.core
        assert core is not None
        case_sets = core.state.case_sets
        joined = case_sets.join("toy/line", (*original.validation, *original.heldout, *original.related))
        flows = core.state.runs
        assert flows[again.run].flow.case_set in joined.relatives
        assert flows[stranger.run].flow.case_set not in joined.relatives
        entries = [journal.read_entry(each.entry) for each in rows(world.store._db, JournalRow)]
        opened = {each.run: each.replay_of for each in entries if isinstance(each, journal.Opened)}
        assert opened == {first.run: "", again.run: first.run, stranger.run: ""}


@pytest.mark.parametrize(
    ("claim", "why"),
    [
        ("another operator's", "another operator's"),
        ("without its key", "another operator's"),
        ("open", "is open; only a finished run"),
        ("other settings", "other settings than the run: budget"),
        ("other agent", "other settings than the run: model"),
    ],
)
async def test_a_run_that_falsely_claims_to_be_a_replay_is_refused(
    tmp_path: Path, claim: str, why: str
) -> None:
    async with started(tmp_path) as world:
        first = await create(world, "first")
        if claim != "open":
            await cancel(world, first.run)
        proof, settings = "first", dict[str, Any]()
        match claim:
            case "another operator's":
                await create(world, "second")
                proof = "second"
            case "without its key":
                proof = ""
            case "other settings":
                settings["budget"] = 200
            case "other agent":
                settings["model"] = "better"
        before = len(list(rows(world.store._db, RunRow)))
        answer = await create(world, "again", proof, replay_of=first.run, **settings)
        assert isinstance(answer, Refused), answer
        assert why in answer.message
        assert len(list(rows(world.store._db, RunRow))) == before


async def test_a_run_of_another_coordinator_is_replayed_with_a_new_secret(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        first = await create(world, "first")
        again = await create(world, "again", "first", replay_of="r-0123456789abcdef")
        assert row(world, again.run).secret != row(world, first.run).secret
        assert row(world, again.run).heldout != row(world, first.run).heldout
        assert row(world, again.run).settings.replay_of == "r-0123456789abcdef"
