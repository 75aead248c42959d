"""A file or socket that nobody closed fails the test in which it is found."""

from __future__ import annotations

import gc
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_worker.episodes.monitor import Monitor

UNCLOSED = ("error::ResourceWarning", "error::pytest.PytestUnraisableExceptionWarning")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            for each in UNCLOSED:
                item.add_marker(pytest.mark.filterwarnings(each))


@pytest.fixture(scope="module")
def monitor() -> Monitor:
    # The pipe stays open, since the monitor's thread lives on: of one at its end it would read without pause.
    commands, _never_written = os.pipe()
    found = Monitor(commands, lambda: None, lambda: None)
    found.start()
    return found


@pytest.fixture(scope="module", autouse=True)
def _own_garbage() -> Iterator[None]:
    """Garbage of other folders' files is not reported here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gc.collect()
    yield
    gc.collect()
