"""Every artifact of a run has the fields, the order and the values of its golden file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from golden_artifacts import GOLDEN, artifacts, play_golden
from played import DATA
from published_checker import check_run

pytestmark = pytest.mark.timeout(600)
REMEDY = "on purpose: PYTHONPATH=tests/support python tests/conformance/protocol/golden_artifacts.py"
NAMES = sorted(path.name for path in GOLDEN.iterdir())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return play_golden(tmp_path_factory.mktemp("golden"))


@pytest.mark.parametrize("name", NAMES)
def test_artifact_is_what_its_golden_file_says(run: Path, name: str) -> None:
    assert artifacts(run)[name] == (GOLDEN / name).read_text(), REMEDY


def test_every_artifact_has_a_golden_file(run: Path) -> None:
    assert sorted(artifacts(run)) == NAMES, REMEDY
    assert check_run(run) == []


def test_hashes_are_of_the_files_bytes(run: Path) -> None:
    versions = json.loads((run / "run.json").read_bytes())["versions"]
    files = {"agents_md": run / "workspace" / "AGENTS.md"}
    files |= {f"data_{split}": DATA / "toy_line" / f"{split}.json" for split in ("train", "valid", "heldout")}
    for name, path in files.items():
        assert versions[f"{name}_hash"] == f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
