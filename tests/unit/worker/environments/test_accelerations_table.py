"""Accelerations stand aside for unproved versions, are switched by option, and touch one environment only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import structlog
from minigrid.core.grid import Grid
from minigrid.core.world_object import Ball, Door, Wall

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make, process_environment
from evopolicy_worker.environments.accelerations import ACCELERATIONS, table
from evopolicy_worker.environments.accelerations.minigrid_view import _row
from evopolicy_worker.environments.accelerations.table import PROVED, usable
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment

MAZE = "gymnasium/MiniGrid-FourRooms-v0"


def names(environment: Any) -> tuple[str, ...]:
    assert isinstance(environment, GymnasiumEnvironment)
    environment.close()
    return environment.accelerations


def test_an_unproved_version_switches_the_acceleration_off_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(table, "_reported", set())
    monkeypatch.setattr(table, "version", lambda name: "99.0")
    with structlog.testing.capture_logs() as logs:
        assert names(make(MAZE, accelerations=True)) == ()
        assert names(make(MAZE, accelerations=True)) == ()
    assert [(entry["acceleration"], entry["installed"]) for entry in logs] == [
        ("minigrid_view", {"minigrid": "99.0"})
    ]
    assert logs[0]["log_level"] == "warning"


def test_an_acceleration_that_does_not_hold_on_this_machine_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    from evopolicy_worker.environments.accelerations import car_racing_frame

    assert car_racing_frame.holds()
    monkeypatch.setattr(table, "_reported", set())
    monkeypatch.setattr(car_racing_frame, "holds", lambda: False)
    with structlog.testing.capture_logs() as logs:
        assert names(make("gym/racing", accelerations=True)) == ("car_racing_road",)
    assert [entry["acceleration"] for entry in logs] == ["car_racing_frame"]


def test_every_acceleration_is_proved_with_the_tested_versions() -> None:
    with structlog.testing.capture_logs() as logs:
        assert all(usable(acceleration) for acceleration in ACCELERATIONS)
    assert logs == []
    assert {name for one in ACCELERATIONS for name in one.distributions} == set(PROVED)


def test_accelerations_are_switched_by_the_process_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EVOPOLICY_ACCELERATIONS", raising=False)
    assert names(make(MAZE)) == ("minigrid_view",)
    monkeypatch.setenv("EVOPOLICY_ACCELERATIONS", "off")
    assert names(make(MAZE)) == ()
    assert names(make(MAZE, accelerations=True)) == ("minigrid_view",)


def test_a_slot_process_inherits_the_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EVOPOLICY_ACCELERATIONS", raising=False)
    assert process_environment()["EVOPOLICY_ACCELERATIONS"] == "on"
    monkeypatch.setenv("EVOPOLICY_ACCELERATIONS", "off")
    assert process_environment()["EVOPOLICY_ACCELERATIONS"] == "off"


def test_the_librarys_own_class_stays_as_it_is() -> None:
    accelerated: Any = make(MAZE, accelerations=True)
    plain: Any = make(MAZE, accelerations=False)
    kind = type(plain.bare)
    assert isinstance(accelerated.bare, kind)
    assert type(accelerated.bare).__name__ == kind.__name__
    assert "gen_obs" not in kind.__dict__
    accelerated.reset(Case(seed=1))
    assert type(make(MAZE, accelerations=False).bare) is kind  # type: ignore[attr-defined]


def test_rows_pass_visibility_on_as_the_librarys_mask_does() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        grid = Grid(7, 7)
        for x in range(7):
            for y in range(7):
                things = (Wall(), Door("red", is_open=bool(rng.integers(2))), Ball(), None, None, None)
                grid.set(x, y, things[rng.integers(6)])
        cells: list[list[Any]] = [[grid.get(x, y) for x in range(7)] for y in range(7)]
        mask = grid.process_vis((3, 6))
        seen = 1 << 3
        for y in range(6, -1, -1):
            clear = sum(1 << x for x, cell in enumerate(cells[y]) if cell is None or cell.see_behind())
            row, seen = _row(seen, clear)
            assert [bool(row >> x & 1) for x in range(7)] == mask[:, y].tolist()
