"""Every way in which a slot can end has one row in the table of endings, and its verdict."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_worker.slot_protocol import endings
from evopolicy_worker.slot_protocol.endings import FAULTS, TABLE, Ending, First, How

EXAMPLES: dict[str, tuple[Ending, str | None]] = {
    "a policy's process before the bundle's code": (Ending("policy", "SIGKILL", began=False), None),
    "a limit was passed": (Ending("policy", "SIGKILL", "oom"), "oom"),
    "it exited": (Ending("policy", "exit"), "killed"),
    "it crashed": (Ending("policy", "fault"), "killed"),
    "a signal that it can send itself": (Ending("policy", "signal"), "killed"),
    "it closed its pipe": (Ending("policy", "pipe"), "killed"),
    "it broke the pipes' rules": (Ending("policy", "frame"), "killed"),
    "killed or stopped where it can signal itself": (Ending("policy", "SIGKILL", held=False), "killed"),
    "killed or stopped, sealed, and no limit explains it": (Ending("policy", "SIGKILL"), None),
    "bubblewrap or the zygote": (Ending("sandbox", "SIGKILL"), None),
    "the environment crashed on its actions": (Ending("environment", "fault"), "killed"),
    "the environment crashed before any": (Ending("environment", "fault", began=False), None),
    "the environment overran on its actions, as in earlier attempts": (
        Ending("environment", "overrun", again=True),
        "killed",
    ),
    "the environment overran": (Ending("environment", "overrun"), None),
    "the environment was killed or stopped": (Ending("environment", "SIGKILL"), None),
    "the worker": (Ending("supervisor", "SIGKILL"), None),
}


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.name)
def test_each_row_of_the_table_gives_its_verdict(row: endings.EndingRule) -> None:
    ending, expected = EXAMPLES[row.name]
    assert row.fits(ending)
    assert endings.verdict(ending) == expected


def every_ending() -> Iterator[Ending]:
    limits = (None, "oom", "cpu_limit", "act_timeout", "episode_timeout", "process_limit")
    either = (True, False)
    for ending in itertools.product(get_args(First), get_args(How), limits, either, either, either):
        if ending[:2] != ("policy", "overrun"):
            yield Ending(*ending)  # type: ignore[arg-type]


def test_every_ending_fits_exactly_one_row() -> None:
    for ending in every_ending():
        assert sum(row.fits(ending) for row in TABLE) == 1, ending


def test_whatever_a_policy_can_bring_about_is_its_own() -> None:
    for ending in every_ending():
        ours = endings.verdict(ending) is None
        if ending.first == "policy" and ending.began:
            # Nothing but what only others can do to a sealed process, and no limit asks for.
            provable = ending.held and ending.limit is None and ending.how in ("SIGKILL", "stop")
            assert ours == provable, ending
        elif ending.first == "environment":
            its_own = (
                ending.again if ending.how == "overrun" else ending.began and ending.how in ("exit", "fault")
            )
            assert ours == (not its_own), ending
        else:
            assert ours, ending


@given(st.integers(0, 0xFFFF), st.sampled_from(get_args(First)), st.booleans(), st.booleans())
def test_every_status_of_a_process_has_a_verdict(
    status: int, first: endings.First, began: bool, held: bool
) -> None:
    how = endings.how(status)
    endings.verdict(Ending(first, how, None, began, held))
    ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    assert (how == "SIGKILL") == (ended_by == signal.SIGKILL)
    assert (how == "fault") == (ended_by in FAULTS)
