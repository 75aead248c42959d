"""Success rate, generalisation gap and area under curves, recomputed from their definitions in plain numpy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from invented.study import write_suite

from evopolicy_results.studies.study import Study, study

ENVS = ["gym/acrobot", "gym/continuouscar", "gymnasium/MiniGrid-FourRooms-v0", "gym/ant5"]
REACHED_ABOVE = {"gym/acrobot": -500.0, "gym/continuouscar": 0.0, "gymnasium/MiniGrid-FourRooms-v0": 0.0}


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, dict[tuple[str, str], list[Path]]]:
    folder = tmp_path_factory.mktemp("runs")
    by_cell: dict[tuple[str, str], list[Path]] = {}
    for path in write_suite(folder, environments=ENVS, repeats=3, seed=5):
        record = json.loads((path / "run.json").read_bytes())
        by_cell.setdefault((record["agent"]["entry"], record["env"]), []).append(path)
    return study([folder]), by_cell


def outcome(path: Path) -> dict:
    return json.loads((path / "run.json").read_bytes())["outcome"]


def validations(path: Path) -> list[tuple[int, float]]:
    """(episodes consumed, validation mean) of each scored submit, from the checkpoints' own files."""
    found, consumed = [], 0
    for meta in sorted((path / "checkpoints").glob("submit_*/_meta.json")):
        each = json.loads(meta.read_bytes())
        consumed = each["remaining_budget_before"] - each["remaining_budget_after"] + consumed
        if each["validation_status"] == "ok" and each["val_mean"] is not None:
            found.append((consumed, each["val_mean"]))
    return found


def test_success_and_generalisation_gap_are_their_definitions(generated: tuple) -> None:
    found, by_cell = generated
    rows = {(one.entry, one.env): one for suite in found.suites for one in suite.statistics.generalisation}
    assert set(rows) == set(by_cell)
    for key, paths in by_cell.items():
        heldout = np.array([outcome(path)["heldout_returns"] for path in paths])
        validation = np.array([max(value for _, value in validations(path)) for path in paths])
        row = rows[key]
        assert row.heldout == pytest.approx(heldout.mean())
        assert row.validation == pytest.approx(validation.mean())
        assert row.optimism == pytest.approx((validation - heldout.mean(axis=1)).mean())
        above = REACHED_ABOVE.get(key[1])
        assert row.success == (None if above is None else pytest.approx((heldout > above).mean()))


def test_area_under_a_curve_is_its_integral(generated: tuple) -> None:
    found, by_cell = generated
    budget = 128
    areas: dict[tuple[str, str], list[float | None]] = {}
    for one in found.evolutions:
        areas.setdefault((one.entry, one.env), []).append(one.area)
    for env in ENVS:
        cells = {key: paths for key, paths in by_cell.items() if key[1] == env}
        curves = {path: validations(path) for paths in cells.values() for path in paths}
        base = outcome(next(iter(curves)))["random_reference"]["mean_return"]
        top = max(value for steps in curves.values() for _, value in steps)
        for key, paths in cells.items():
            expected = []
            for path in paths:
                # The best validation mean after each single episode, 0 of the scale before the first.
                best = np.full(budget, base)
                for consumed, value in curves[path]:
                    best[consumed:] = (
                        np.maximum(best[consumed:], value) if (best[consumed:] > base).any() else value
                    )
                expected.append(np.clip((best - base) / (top - base), 0.0, 1.0).mean())
            assert sorted(area for area in areas[key] if area is not None) == pytest.approx(sorted(expected))
