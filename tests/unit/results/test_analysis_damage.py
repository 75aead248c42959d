"""Runs damaged at random, in a value of one of their files or in a few bytes: each is read, or left out with a
reason."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from edits import overwrite
from hypothesis import given, settings
from hypothesis import strategies as st
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_results.html.pages import trace_page
from evopolicy_results.notebook import tables_of, trace
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.studies.study import study_of
from evopolicy_results.tables.latex import to_latex
from evopolicy_results.tables.table import to_csv, to_markdown

VERSIONS = [
    Version(policy(gain=1.0), (-200.0, -100.0), -180.0, says="I start."),
    Version({"policy.py": "import nothing\n"}, (0.0,), None, "import_error"),
    Version(policy(gain=2.0, planner=True), (-90.0,), -95.0, failed=(0,), says="It was too slow."),
]
STRANGE = [None, True, -1, 0, 1.5, 1e308, -1e308, 1e-320, 10**30, "", "../../x", "<b>", "a\nb", "\0", [], {}]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    write_run(folder, VERSIONS)
    write_run(folder, VERSIONS[:1], entry="Agent B")
    return folder


def test_pipes_in_place_of_a_runs_files_do_not_stop_the_reader(whole: Path, tmp_path: Path) -> None:
    waited: list[Path] = []

    def waits(number: int, frame: object) -> None:
        waited.append(path)
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, waits)
    try:
        files = sorted(path for path in (whole / "Agent-A").rglob("*") if path.is_file())
        assert {path.name for path in files} > {"run.json", "policy.py"}
        for k, path in enumerate(files):
            shutil.copytree(whole, tmp_path / str(k))
            replaced = tmp_path / str(k) / path.relative_to(whole)
            replaced.unlink()
            os.mkfifo(replaced)
            signal.alarm(10)
            loaded = load_runs([tmp_path / str(k)])
            signal.alarm(0)
            assert "Agent B" in {run.entry for run in loaded.runs}, path
            assert not waited
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@settings(max_examples=75, deadline=None)
@given(st.randoms(use_true_random=False))
def test_damaged_run_is_read_or_left_out_and_never_a_crash(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, rng: random.Random
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(whole, folder / "runs")
    files = sorted(path for path in (folder / "runs" / "Agent-A").rglob("*") if path.is_file())
    records = [path for path in files if path.suffix == ".json"]
    sources_and_logs = [path for path in files if path.suffix in (".py", ".jsonl")]
    for _ in range(rng.randint(1, 3)):
        damage, damaged = rng.choice(
            [(damage_value, records), (damage_bytes, records), (damage_bytes, sources_and_logs)]
        )
        damage(rng.choice(damaged), rng)
    loaded = load_runs([folder / "runs"])
    assert "Agent B" in {run.entry for run in loaded.runs}
    assert len(loaded.runs) + len(loaded.left_out) == 2
    assert all(left.reason for left in loaded.left_out)
    found = study_of(loaded.runs, left_out=loaded.left_out, allow_mixed=True, resamples=5)
    for table in tables_of(found):
        assert to_csv(table)
        assert to_markdown(table)
        assert to_latex(table)
    for run in loaded.runs:
        assert trace_page(trace(run), look=None, image_links={}, videos={})
    shutil.rmtree(folder)


def damage_value(path: Path, rng: random.Random) -> None:
    """Puts something strange in one place of a JSON file; one that is damaged already stays as it is."""
    try:
        document = json.loads(path.read_bytes())
    except ValueError:
        return
    holder, key = rng.choice(list(places(document)))
    holder[key] = rng.choice(STRANGE)
    overwrite(path, json.dumps(document))


def damage_bytes(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 12) if data else 0):
        data[rng.randrange(len(data))] = rng.choice([0, 10, 34, 92, 128, 214, rng.randrange(256)])
    overwrite(path, data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data)


def places(document: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key or index) of a JSON document."""
    if isinstance(document, dict | list):
        for key in list(document) if isinstance(document, dict) else range(len(document)):
            yield document, key
            yield from places(document[key])
