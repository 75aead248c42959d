"""Real processes are killed, frozen and starved at seeded instants of whole runs, and every run comes to the same.

All runs are played by `fault_matrix.py`, in a process of its own because it adopts whatever is left over; each test
waits for its row. All kinds of faults: `pytest tests/faults --fault-seeds 1`, more instants of each by a larger number;
the table:
`make faults`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_matrix import Case, cases

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]


SUPPORT = Path(__file__).parents[1] / "support"
PARTS = 2
"""Clusters at once: most of a run with a fault is waiting."""


class Matrix:
    """The rows that one program has printed so far."""

    def __init__(self, seeds: int, part: int) -> None:
        self.process = subprocess.Popen(
            [
                *(sys.executable, str(Path(__file__).with_name("fault_matrix.py")), "--json"),
                *("--fault-seeds", str(seeds), "--part", str(part), str(PARTS)),
            ],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(SUPPORT)},
        )
        self._rows: dict[tuple[str, str, int], dict[str, Any]] = {}

    def row(self, target: str, fault: str, seed: int) -> dict[str, Any]:
        """Waits for it."""
        assert self.process.stdout is not None
        while (target, fault, seed) not in self._rows:
            line = self.process.stdout.readline()
            assert line, f"the program ended with status {self.process.wait()}"
            row = json.loads(line)
            self._rows[row["target"], row["fault"], row["seed"]] = row
        return self._rows[target, fault, seed]


@pytest.fixture(scope="module")
def matrices(request: pytest.FixtureRequest) -> Iterator[list[Matrix]]:
    matrices = [Matrix(request.config.getoption("--fault-seeds"), part) for part in range(PARTS)]
    yield matrices
    # Also when only some rows were asked for: it takes everything down that it has started.
    for matrix in matrices:
        matrix.process.terminate()
    for matrix in matrices:
        matrix.process.communicate(timeout=60)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "case" in metafunc.fixturenames:
        found = [
            (case, part)
            for part in range(PARTS)
            for case in cases(metafunc.config.getoption("--fault-seeds"), part, PARTS)
        ]
        ids = [case.name.replace(" ", "-") for case, _ in found]
        metafunc.parametrize(("case", "part"), found, ids=ids)


def test_an_undisturbed_run_spends_its_budget_and_leaves_no_process(matrices: list[Matrix]) -> None:
    for matrix in matrices:
        assert matrix.row("nothing", "one host", 0)["wrong"] == []


def test_a_run_comes_to_the_same_through(case: Case, part: int, matrices: list[Matrix]) -> None:
    row = matrices[part].row(case.target, case.fault, case.seed)
    assert row["wrong"] == []
    assert row["phase"]


def test_nothing_is_left_of_the_clusters(matrices: list[Matrix]) -> None:
    for matrix in matrices:
        assert matrix.process.stdout is not None
        assert [line for line in matrix.process.stdout if json.loads(line)["wrong"]] == []
        matrix.process.wait()


def test_runs_and_sweeps_come_to_the_same_through_several_faults_at_once(tmp_path: Path) -> None:
    program = [sys.executable, str(Path(__file__).with_name("fault_matrix.py"))]
    played = subprocess.run(
        [*program, "--chaos", "15", "--keep", str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SUPPORT)},
    )
    assert played.returncode == 0, played.stdout
