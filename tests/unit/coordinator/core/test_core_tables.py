"""The core's tables name a rule for whatever the rules arm and tell."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args

import pytest

import evopolicy_coordinator.core
from evopolicy_coordinator.core.machine import NEWS, POLLS, TIMERS
from evopolicy_coordinator.core.structures import InvariantError
from evopolicy_coordinator.core.structures.timers import PollKind
from evopolicy_coordinator.core.tables import step
from evopolicy_coordinator.core.tables.model import JOB, RUN, SUBMIT, GroupKind, Table, check

CORE = Path(evopolicy_coordinator.core.__file__).parent


def armed() -> set[str]:
    """Kinds of the deadlines that the core's code arms."""
    return {
        node.args[0].elts[0].value
        for path in CORE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in ("arm", "arm_once")
        and isinstance(node.args[0], ast.Tuple)
        and isinstance(node.args[0].elts[0], ast.Constant)
    }


def test_each_deadline_that_is_armed_has_a_rule() -> None:
    assert armed() == set(TIMERS)


def test_each_piece_of_news_has_someone_who_hears_it() -> None:
    groups = get_args(GroupKind)
    kinds = {
        step.EpisodesDone: groups,
        step.EnvironmentFailed: groups,
        step.FlowPinned: ("run", "evaluation"),
    }
    wanted = {(news, kind) for news in get_args(step.News) for kind in kinds.get(news, ("",))}
    assert set(NEWS) == wanted


def test_each_kind_of_long_poll_is_answered_in_time() -> None:
    assert set(POLLS) == set(get_args(PollKind))


@pytest.mark.parametrize("table", [RUN, SUBMIT, JOB])
def test_a_table_of_transitions_is_closed_and_ends(table: Table) -> None:
    assert {after for states in table.values() for after in states} <= set(table)
    assert not all(table.values())


def test_what_may_not_follow_is_refused() -> None:
    check(JOB, "a job", "queued", "leased")
    with pytest.raises(InvariantError, match="a job: queued cannot follow closed"):
        check(JOB, "a job", "closed", "queued")
