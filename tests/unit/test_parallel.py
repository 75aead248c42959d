"""The forked processes that play the tests: every test is reported once, also those of a process that dies."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from program_runs import run_program

SUPPORT = Path(__file__).parents[1] / "support"
CONFTEST = f"""
import sys

sys.path.insert(0, {str(SUPPORT)!r})
from parallel import Parallel


def pytest_runtestloop(session):
    Parallel(session, lambda item: item.path).play(2)
    return True
"""
FILES = {
    "test_plain.py": """
import warnings
import pytest

def test_passes():
    warnings.warn("a word of warning")

@pytest.mark.skip(reason="for a reason")
def test_is_skipped(): pass

def test_fails():
    assert [1] == [2]
""",
    "test_dying.py": """
import os

def test_before(): pass
def test_dies(): os._exit(7)
def test_after(): pass
""",
    "test_alone.py": """
import os
import pytest

pytestmark = pytest.mark.alone

def test_no_other_process_lives(): assert open("torn_down").read() == "once "
""",
    "test_shared.py": """
import os
import pytest

@pytest.fixture(scope="module")
def process():
    yield os.getpid()
    open("torn_down", "a").write("once ")

def test_has_a_fixture(process): assert process == os.getpid()
def test_has_the_same(process): assert process == os.getpid()
""",
}


def played(folder: Path, *options: str) -> str:
    for name, text in {"conftest.py": CONFTEST, **FILES}.items():
        (folder / name).write_text(text)
    words = (sys.executable, "-m", "pytest", "-rA", "-p", "no:cacheprovider", *options)
    return run_program(*words, cwd=folder).stdout


def test_each_test_is_reported_once_also_those_of_a_process_that_dies(tmp_path: Path) -> None:
    said = played(tmp_path)
    outcomes = re.findall(
        r"^(PASSED|FAILED|SKIPPED|ERROR) (?:\[1\] )?(\S+?)(?::\d+:)?(?: |$)", said, re.MULTILINE
    )
    assert sorted(outcomes) == [
        ("FAILED", "test_dying.py::test_dies"),
        ("FAILED", "test_plain.py::test_fails"),
        ("PASSED", "test_alone.py::test_no_other_process_lives"),
        ("PASSED", "test_dying.py::test_after"),
        ("PASSED", "test_dying.py::test_before"),
        ("PASSED", "test_plain.py::test_passes"),
        ("PASSED", "test_shared.py::test_has_a_fixture"),
        ("PASSED", "test_shared.py::test_has_the_same"),
        ("SKIPPED", "test_plain.py"),
    ]
    assert "ended with status 7" in said
    assert "assert [1] == [2]" in said
    assert said.count("UserWarning: a word of warning") == 1
    assert (tmp_path / "torn_down").read_text() == "once "


@pytest.mark.parametrize("option", ["-x", "--maxfail=1"])
def test_the_first_failure_stops_all_if_that_is_asked(tmp_path: Path, option: str) -> None:
    # Another process may fail a second one meanwhile.
    assert re.search("stopping after [12] failures", played(tmp_path, option))
