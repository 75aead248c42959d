"""Runs that start from a submit of another: the coordinator believes its own rows, not the operator.

Attacks, each with its defence:
- an operator forges the lineage of a run, or starts from a run of another cluster, or of another user: the
  digest must be the one that the earlier run's gateway sent; the run's folder must be the operator's own.
- an operator picks the start by its hidden result, or has hidden cases played beside the agent that
  continues: `parent_scored` is the coordinator's, and handed on; both runs are related; such runs are on no
  leaderboard.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.service_world import Requested, World, started

from evopolicy_common.messages import gateway
from evopolicy_common.messages.run_settings import Line, Start
from evopolicy_common.messages.worker import Refused
from evopolicy_common.records import journal
from evopolicy_common.wire import keys
from evopolicy_coordinator.core.contract.records import DocumentRow
from evopolicy_coordinator.core.tables.model import Run
from evopolicy_coordinator.storage.store import rows

TREE = "ab" * 32


async def create(world: World, key: str, start: Start | None = None, **settings: Any) -> Any:
    return await world.answer(world.creating(key, start=start, **settings))


async def parent(
    world: World, tree: str = TREE, key: str = "parent", start: Start | None = None, **settings: Any
) -> Any:
    """An open run with one submit, whose workspace is recorded."""
    created = await create(world, key, start, **settings)
    accepted = await world.answer(world.submit(created, "submit", tree=tree))
    assert isinstance(accepted, gateway.SubmitAccepted)
    return created


def run_of(world: World, created: Any) -> Run:
    core = world.service.host.core
    assert core is not None
    return core.state.runs[created.run]


def start_of(world: World, created: Any) -> Start:
    start = run_of(world, created).row.settings.start
    assert start is not None
    return start


async def test_a_start_from_an_open_run_is_committed_to_as_unscored(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        before = await parent(world)
        wanted = Start(run=before.run, submit_index=0, tree=TREE, parent_scored=True)
        after = await create(world, "child", wanted)
        assert start_of(world, after) == msgspec.structs.replace(
            wanted, parent_scored=False, line=Line(sandbox_tier="bwrap")
        )
        assert run_of(world, after).ledger.available == 100
        documents = [row for row in rows(world.store._db, DocumentRow) if row.run == after.run]
        opening = msgspec.json.decode(documents[0].data, type=journal.Opening)
        assert opening.settings.start == start_of(world, after)


@pytest.mark.parametrize("forged", ["tree", "submit", "run", "environment", "unrecorded", "profile"])
async def test_a_forged_start_is_refused(tmp_path: Path, forged: str) -> None:
    async with started(tmp_path) as world:
        before = await parent(world, tree="" if forged == "unrecorded" else TREE)
        start = Start(run=before.run, submit_index=0, tree=TREE)
        settings: dict[str, Any] = {}
        match forged:
            case "tree":
                start = msgspec.structs.replace(start, tree="cd" * 32)
            case "submit":
                start = msgspec.structs.replace(start, submit_index=1)
            case "run":
                start = msgspec.structs.replace(start, run="r-0123456789abcdef")
            case "unrecorded":
                start = msgspec.structs.replace(start, tree="")
            case "environment":
                settings = {"env": "gym/acrobot"}
            case _:
                settings = {"profile": "published"}
        answer = await create(world, "child", start, **settings)
        assert isinstance(answer, Refused)
        assert answer.status == "invalid_settings"
        core = world.service.host.core
        assert core is not None
        assert list(core.state.runs) == [before.run]


async def test_a_start_from_an_ended_run_hands_its_stamp_on(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        before = await parent(world)
        await close(world, before, {})
        child = await parent(world, key="child", start=Start(run=before.run, submit_index=0, tree=TREE))
        assert start_of(world, child).parent_scored
        # The child is open: no result of its own chose the place, but one of its parent's did.
        grandchild = await create(world, "grandchild", Start(run=child.run, submit_index=0, tree=TREE))
        assert start_of(world, grandchild).parent_scored


TOLD: tuple[tuple[dict[str, Any], tuple[str, str]], ...] = (
    ({"jail": "bwrap", "agent": {"model_use": {"metering": "relay"}}}, ("bwrap", "relay")),
    ({"jail": "none", "agent": {"model_use": None, "model_string": "m"}}, ("none", "unknown")),
    (
        {"jail": "bwrap, open network", "agent": {"model_use": {"metering": "agent"}}},
        ("bwrap, open network", "agent"),
    ),
    ({"jail": "bwrap"}, ("bwrap", "nothing")),
    ({"jail": ["bwrap"], "agent": {"model_use": {"metering": 7}}}, ("unknown", "unknown")),
    ({"jail": "bwrap as ever", "agent": {"model_use": "relay"}}, ("unknown", "nothing")),
    ({"agent": "evolve"}, ("unknown", "nothing")),
    ({}, ("unknown", "nothing")),
)


@pytest.mark.parametrize("told", range(len(TOLD)))
async def test_a_start_hands_on_the_weakest_conditions_of_its_line(tmp_path: Path, told: int) -> None:
    """Attack: an agent without a jail plays a run, and a jailed one submits its policy in a run that starts from
    it. Defence: the coordinator stamps the start with the conditions that gateways told at the ends of the runs
    before, whatever else they tell."""
    record, (jail, metering) = TOLD[told]
    async with started(tmp_path) as world:
        before = await parent(world, sandbox_tier="landlock")
        forged = Line(jail="bwrap", sandbox_tier="bwrap", metering="nothing")
        start = Start(run=before.run, submit_index=0, tree=TREE, line=forged)
        early = await create(world, "early", start)
        assert start_of(world, early).line == Line(sandbox_tier="landlock")
        await close(world, before, {"record": record})
        child = await parent(world, key="child", start=start)
        line = Line(jail=jail, sandbox_tier="landlock", metering=metering)
        assert start_of(world, child).line == line
        await close(world, child, {"record": TOLD[0][0]})
        grandchild = await create(world, "grandchild", Start(run=child.run, submit_index=0, tree=TREE))
        weaker = "relay" if metering == "nothing" else metering
        assert start_of(world, grandchild).line == msgspec.structs.replace(line, metering=weaker)


async def close(world: World, created: Any, agent: dict[str, Any]) -> None:
    message = gateway.CloseRun(run=created.run, token=created.capability, reason="agent_stopped", agent=agent)
    closed = Requested(keys.gateway_key("c", created.run, "close"), message)
    assert isinstance(await world.answer(closed), gateway.RunClosed)


async def test_parent_and_start_are_related_when_each_has_its_own_hidden_cases(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        before = await parent(world, hidden_cases="per_run")
        start = Start(run=before.run, submit_index=0, tree=TREE)
        child = await parent(world, key="child", start=start, hidden_cases="per_run")
        again = Start(run=child.run, submit_index=0, tree=TREE)
        grandchild = await create(world, "grandchild", again, hidden_cases="per_run")
        stranger = await create(world, "stranger", hidden_cases="per_run")
        assert run_of(world, child).row.heldout != run_of(world, before).row.heldout

        def relatives(created: Any) -> set[Any]:
            case_set = run_of(world, created).flow.case_set
            assert case_set is not None
            runs = (before, child, grandchild, stranger)
            return {one.run for one in runs if run_of(world, one).flow.case_set in case_set.relatives}

        family = {before.run, child.run, grandchild.run}
        assert [relatives(one) for one in (before, child, grandchild)] == [family, family, family]
        assert relatives(stranger) == {stranger.run}
