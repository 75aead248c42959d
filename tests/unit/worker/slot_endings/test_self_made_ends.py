"""A policy that harms itself has failed, or nothing changes; neither gives it another throw of its dice."""

from __future__ import annotations

import tomllib
from pathlib import Path
from textwrap import indent

import msgspec
import pytest
from slots import HONEST, QUICK, Slots, acting, pid_of, rows
from stateful_policy import kill_policy, struck

_ENDS = tomllib.loads(Path(__file__).with_name("self_made_ends.toml").read_text())
SELF_MADE = {name: indent(code, " " * 12).strip() for name, code in _ENDS.items()}

CLOCKED = acting(
    """
        self.n += 1
        if self.n == 1:
            # Its luck.
            return [(time.time_ns() % 1000) / 1000]
        if self.n == AT:
            WAY
        return [0.0]
    """,
    init="self.n = 0",
    before="""
        import ctypes, os, resource, signal, struct, sys, threading, time

        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t] + [ctypes.c_int] * 3 + [ctypes.c_long]

        def every(send):
            for number in [9, 19, 20, 21, 22, *range(1, 65)]:
                try:
                    send(number)
                except (OSError, ValueError):
                    pass
            time.sleep(0.05)

        def timer(number):
            which = ctypes.c_int()
            event = struct.pack("<qii48x", 0, number, 0)
            if libc.syscall(222, 1, event, ctypes.byref(which)):
                raise OSError(ctypes.get_errno(), "timer_create")
            libc.syscall(223, which.value, 0, struct.pack("<qqqq", 0, 0, 0, 10_000_000), None)

        def run(code):
            at = libc.mmap(None, 4096, 7, 0x22, -1, 0)
            ctypes.memmove(at, code, len(code))
            ctypes.CFUNCTYPE(None)(at)()
    """,
)


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
@pytest.mark.parametrize("at", [4, 60])
def test_a_policy_whose_luck_is_the_clock_never_throws_again(slots: Slots, tier: str, at: int) -> None:
    """Attack: ends itself, its sandbox, or its environment after bad luck, to be played again. Defence:
    every end that it can cause is its result; after a restart, the actions that it returned remain
    valid (table in `docs/explanation/hostile-policies.md`)."""
    limits = msgspec.structs.replace(QUICK, act_wall_s=1.0, cpu_s=1.5)
    slot = slots.slot(tier)  # type: ignore[arg-type]
    slots.play(HONEST, tier=tier)
    pid = pid_of(slot)
    for name, way in SELF_MADE.items():
        slot._stderr.clear()
        outcome = slots.play(CLOCKED.replace("WAY", way).replace("AT", str(at)), tier=tier, limits=limits)
        assert outcome.length == 60, name
        assert not any("started again" in line for line in slot._stderr), (name, outcome.failure)
        if outcome.failure is not None:
            assert outcome.failure.step_index == at - 1, name
    assert pid_of(slot) == pid
    assert slots.play(HONEST, tier=tier).failure is None


def test_what_a_policy_had_returned_stands_when_it_is_started_again(slots: Slots) -> None:
    """Attack: ends itself, its sandbox, or its environment after bad luck, to be played again. Defence:
    every end that it can cause is its result; after a restart, the actions that it returned remain
    valid (table in `docs/explanation/hostile-policies.md`)."""
    luck = "luck = (time.time_ns() // 1000 % 1_000_000) / 1e6; print(luck, flush=True); return [luck]"
    source = CLOCKED.replace("return [(time.time_ns() % 1000) / 1000]", luck)
    source = source.replace("WAY", "time.sleep(3)").replace("AT", "31")
    (outcome,) = slots.run(struck(slots.slot(), slots, kill_policy, source))
    assert outcome.failure is None
    # What it says it threw is the second throw; what it played is the first.
    assert rows(outcome)[0].action != [float(outcome.stdout)]
    assert isinstance(rows(outcome)[0].action[0], float)
