"""A checkpoint's folder: the policy's files with their metadata, read back whole, in this form and the one before."""

from __future__ import annotations

import ast
import gc
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_common.errors import BundleError, ProtocolError
from evopolicy_common.records.code_metrics import MAX_PARSED_BYTES, code_metrics, parse
from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.policies.bundles import MAX_FILES, BundleFile, pack
from evopolicy_common.records.policies.checkpoints import CheckpointMeta, measured

META = CheckpointMeta(
    submit_index=2,
    submit_time="2026-01-01T00:00:00.000000Z",
    n_episodes_requested=4,
    remaining_budget_before=6,
    remaining_budget_after=2,
    validation_status="ok",
    mean_return=1.0,
    val_mean=2.0,
)


def test_a_bundle_returns_from_its_checkpoint_with_metadatas_names(tmp_path: Path) -> None:
    contents = {"policy.py": b"class Policy: ...\n", "run.sh": b"true\n", "_meta.json": b"\xff mine"}
    contents |= {"metrics.json": b"{}", "deep/metrics.json": b"[]", "system/policy.py": b"1"}
    executable = ("run.sh", "_meta.json")
    bundle = pack([BundleFile(path, path in executable, data) for path, data in contents.items()])
    folder = tmp_path / "submit_002"
    checkpoints.write(folder, META, bundle, measured(bundle))
    assert checkpoints.bundle_of(folder) == bundle
    meta = checkpoints.read_meta(folder)
    assert meta is not None
    assert (meta.bundle, meta.snapshot_files) == (bundle.digest, [file.path for file in bundle.files])
    assert [file.path for file in meta.shadowed_files] == ["_meta.json", "metrics.json"]
    assert (folder / "deep/metrics.json").read_bytes() == b"[]"
    assert not (folder / "policy.py").stat().st_mode & 0o222
    assert (folder / "run.sh").stat().st_mode & 0o100
    system = checkpoints.without_metadata(bundle.files)
    kept = ["deep/metrics.json", "policy.py", "run.sh", "system/policy.py"]
    assert [file.path for file in system.files] == kept


def test_a_bundle_of_as_many_files_as_there_may_be_comes_back(tmp_path: Path) -> None:
    bundle = pack([BundleFile(f"f{number}", False, b"") for number in range(MAX_FILES)])
    checkpoints.write(tmp_path / "c", META, bundle, measured(bundle))
    assert checkpoints.bundle_of(tmp_path / "c").digest == bundle.digest


def test_a_submit_without_a_bundle_has_a_checkpoint_of_metadata_alone(tmp_path: Path) -> None:
    metrics = measured(None)
    checkpoints.write(tmp_path / "c", META, None, metrics)
    assert {path.name for path in (tmp_path / "c").iterdir()} == checkpoints.METADATA
    assert (metrics.files, metrics.cyclomatic_max) == (0, 0)


def test_damaged_metadata_are_reported(tmp_path: Path) -> None:
    assert checkpoints.read_meta(tmp_path) is None
    checkpoints.write(tmp_path / "c", META, None, measured(None))
    (tmp_path / "c" / "_meta.json").write_text("{}")
    with pytest.raises(ProtocolError, match=r"_meta\.json is not a checkpoint's"):
        checkpoints.read_meta(tmp_path / "c")
    with pytest.raises(BundleError, match=r"_meta\.json"):
        checkpoints.bundle_of(tmp_path / "c")


def test_code_metrics_follow_the_published_definitions() -> None:
    text = """# a comment
import os.path, sys
from . import near
from numpy.linalg import norm


class A:
    async def outer(self, xs):
        def inner(x):
            return x if x and x > 1 and x < 5 else 0
        try:
            async for y in xs:
                pass
        except (KeyError, OSError):
            pass
        except ValueError:
            pass
        match xs:
            case []:
                return [x for x in xs if x if not x]
            case _:
                while True:
                    pass
"""
    found = code_metrics(
        {
            "policy.py": text.encode(),
            "test_a.py": b"if 1:\n    x = 1\n",
            "bad.py": b"def f(:\n",
            "_meta.json": b"not counted",
            "d/.keep": b"",
            "__pycache__/x.py": b"x",
            "data.bin": b"\x00\xff",
        }
    )
    # outer: 1, inner's conditional expression 1 and its two operators 2, except handlers 2 and the try's two 2, async
    # for 1, two cases 2, two conditions of the comprehension 2, while 1; inner: 1 + 1 + 2; the module of test_a.py: 1 +
    # 1.
    assert (found.cyclomatic_max, found.cyclomatic_total) == (14, 14 + 4 + 2)
    assert (found.files, found.python_files, found.test_files) == (4, 3, 1)
    assert (found.functions, found.classes) == (2, 1)
    assert found.imports == ("numpy", "os", "sys")
    assert found.parse_errors == ("bad.py",)
    assert (found.lines, found.source_lines) == (23 + 2 + 1, 20 + 2 + 1)
    assert found.bytes == len(text) + 16 + 8 + 2


def test_hostile_sources_are_measured_in_bounded_time() -> None:
    sources = {
        "dots.py": b"import " + b".".join([b"a"] * 200_000),
        "nested.py": b"(" * 100_000,
        "unary.py": b"x = " + b"-" * 200_000 + b"1",
        "null.py": b"\0",
        "deep.py": b"".join(b" " * depth + b"def f():\n" for depth in range(99)) + b" " * 99 + b"pass\n",
        "large.py": b"#" * (MAX_PARSED_BYTES + 1),
    }
    started = time.process_time()
    found = code_metrics(sources)
    assert time.process_time() - started < 60.0
    assert set(found.parse_errors) >= {"dots.py", "nested.py", "null.py", "large.py"}
    assert found.functions == 99


@pytest.fixture
def restless() -> Iterator[None]:
    """Garbage is collected all the time, each collection runs Python code, and threads take turns at every chance."""
    threshold, interval = gc.get_threshold(), sys.getswitchinterval()

    def collected(*_: object) -> None:
        sum(range(20))

    gc.callbacks.append(collected)
    gc.set_threshold(50)
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)
    gc.set_threshold(*threshold)
    gc.callbacks.remove(collected)


@pytest.mark.usefixtures("restless")
def test_code_is_parsed_beside_other_threads_that_parse() -> None:
    """Python 3.11 ends `ast.parse` with SystemError when another thread parses meanwhile; tracebacks parse too."""
    source = b"\n".join(b"def f%d(a, b): return [x * (a + 1) for x in b if x > a]" % n for n in range(60))
    done = threading.Event()
    failed: list[BaseException] = []

    def others() -> None:
        while not done.is_set():
            try:
                ast.parse(source)
            except SystemError:
                pass

    def ours() -> None:
        try:
            for _ in range(100):
                assert parse(source) is not None
        except BaseException as error:
            failed.append(error)

    beside = threading.Thread(target=others)
    threads = [threading.Thread(target=ours) for _ in range(2)]
    for thread in (beside, *threads):
        thread.start()
    for thread in threads:
        thread.join()
    done.set()
    beside.join()
    assert failed == []
    assert gc.isenabled()
