"""ViZDoom's game is a process in the slot's jail: it plays there, and is gone with its slot."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from slots import Slots, family, pid_of, runs
from waiting import wait_until

from evopolicy_common.errors import WorkerError
from evopolicy_worker.environments import missing

ENV = "gymnasium/VizdoomPredictPosition-v1"

pytestmark = [
    pytest.mark.families,
    pytest.mark.skipif(bool(missing(ENV)), reason=f"{ENV} needs {missing(ENV)}"),
]


@pytest.fixture
def slots(tmp_path: Path) -> Iterator[Slots]:
    found = Slots(tmp_path)
    yield found
    found.close()


def test_a_tier_without_shared_memory_says_so(slots: Slots) -> None:
    with pytest.raises(WorkerError, match="tier bwrap"):
        slots.play_all(None, tier="landlock", env=ENV)


def test_a_closed_slot_leaves_no_game(slots: Slots) -> None:
    slot = slots.new()
    slots.run(slot.start())
    slots.play_all(None, slot=slot, env=ENV)
    processes = family(pid_of(slot))
    assert "vizdoom" in map(_name, processes)
    slots.run(slot.close())
    wait_until(lambda: not [pid for pid in processes if runs(pid)])


def test_an_unjailed_killed_process_leaves_no_game_or_shared_memory(slots: Slots) -> None:
    with slots.running(slots.new("none")) as slot:
        slots.play_all(None, slot=slot, tier="none", env=ENV)
        (game,) = [pid for pid in family(pid_of(slot)) if _name(pid) == "vizdoom"]
        maps = Path(f"/proc/{game}/maps").read_text()
        shared = set(re.findall(r"/dev/shm/ViZDoom\w+", maps))
        assert len(shared) == 3
        os.kill(pid_of(slot), signal.SIGKILL)
        wait_until(lambda: not runs(game))
        assert not [path for path in shared if os.path.exists(path)]


def _name(pid: int) -> str:
    return Path(f"/proc/{pid}/comm").read_text().strip()
