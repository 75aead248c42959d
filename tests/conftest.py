"""Options of the test run."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fault-seeds",
        type=int,
        default=0,
        help="tests/faults: instants at which each kind of fault strikes; 0: some kinds only, at one",
    )
