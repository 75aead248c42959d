"""Episodes beside the libraries' own loops: for each family a seeded sample, bit for bit, with dtypes and the last
observation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import parity_loops
import proofs
import pytest

from evopolicy_common import catalogue
from evopolicy_worker.environments.interface import settings

pytestmark = pytest.mark.families

PROGRAM = Path(__file__).with_name("parity_loops.py")
# Of the browser's pages this software plays its own, with a clock of its own: no library has a loop for them.
PAGES = {"miniwob", "browsergym"}
SUITES = sorted({each.family for each in proofs.table()} - PAGES)


def differences(python: str, family: str, folder: Path) -> dict[str, str]:
    """By id, how our episode differs from the bare loop's, as the two programs tell with an interpreter."""
    file = folder / "episodes"
    sample = parity_loops.drawn(family, list(catalogue.suites()[family].environments))
    alone = [[each] for each in sample] if parity_loops.TABLE["family"].get(family, {}).get("alone") else [[]]
    found: dict[str, str] = {}
    for arguments in (["ours", family, file], *(["bare", file, *ids] for ids in alone)):
        done = subprocess.run(
            [python, "-P", str(PROGRAM), *map(str, arguments)],
            capture_output=True,
            text=True,
            check=False,
            cwd=folder,
            env=dict(os.environ) | settings.process_environment(),
        )
        assert done.returncode == 0, done.stderr[-2000:]
        if arguments[0] == "bare":
            found |= json.loads(done.stdout.splitlines()[-1])
    return found


def named(family: str) -> dict[str, str]:
    """By id, how a difference that the table names begins; empty for those that are to be equal."""
    sample = parity_loops.drawn(family, list(catalogue.suites()[family].environments))
    known = parity_loops.TABLE["differs"]
    return {each: known[each]["begins"] if each in known else "" for each in sample}


@pytest.mark.slow
@pytest.mark.timeout(900)
# A family with an installation of its own is played there: test_environment_of_its_own.py.
@pytest.mark.parametrize("family", sorted({each.family for each in proofs.together()} & set(SUITES)))
def test_a_sample_of_a_family_is_played_as_its_library_plays_it(family: str, tmp_path: Path) -> None:
    sample = named(family)
    found = differences(sys.executable, family, tmp_path)
    assert found.keys() == sample.keys()
    wrong = {
        each: told
        for each, told in found.items()
        if not told.startswith(sample[each]) or bool(told) != bool(sample[each])
    }
    assert wrong == {}


def test_every_family_has_a_loop_and_two_ids_at_least() -> None:
    assert set(SUITES) == catalogue.families().keys() & catalogue.suites().keys() - {"toy"} - PAGES
    for family in SUITES:
        ids = list(catalogue.suites()[family].environments)
        assert len(parity_loops.drawn(family, ids)) >= min(2, len(ids))


@pytest.mark.parametrize(
    ("one", "other", "told"),
    [
        (np.zeros(2, np.float32), np.zeros(2, np.float64), "float32"),
        (np.zeros(2), np.array([0.0, np.nextafter(0, 1)]), "1 of 2"),
        ({"a": 1}, {"b": 1}, "keys"),
        ((1, "x"), (1, "y"), "[1]"),
        ({"a": (np.ones(1), 2)}, {"a": (np.ones(1), 2)}, ""),
    ],
)
def test_a_difference_of_dtype_or_of_one_bit_is_told(one: object, other: object, told: str) -> None:
    found = parity_loops.difference(one, other)
    assert told in found if told else found == ""
