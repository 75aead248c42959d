"""Run directories of strangers: whatever is in place of their files, each command that reads them refuses or is
unaffected.

No reader waits for a pipe, follows a link to this machine's files, reads a file without end, or raises what no command
reports.

Attacks, each with its defence:
- a run directory with links, pipes, devices, files without end, archives or JSON that take gigabytes, damaged
  values of any kind: refused by every command that reads it, with the file's name, or left out with the
  reason.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from commands import words
from invented.policies import Version, policy
from invented.published_runs import write_published_run
from invented.run_dirs import write_run

from evopolicy import load_runs as load_public_runs
from evopolicy._exports import tables, tracking, transcripts
from evopolicy_common.errors import ConfigError, EvopolicyError, ProtocolError
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.npz import read_arrays
from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.records.run_difference import differences
from evopolicy_common.records.run_record import Artifacts, encode_run_record
from evopolicy_common.regular_files import NotThereError, read_regular
from evopolicy_coordinator.web.content.run_detail import Detail
from evopolicy_coordinator.web.content.run_folders import FolderReader
from evopolicy_gateway.harbor import scores
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_results.publish.collect import find_runs
from evopolicy_results.reading import published
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.rescore.play import read_finished
from evopolicy_results.verify import numbers
from evopolicy_results.verify.source import read_run

VERSIONS = [
    Version(policy(gain=1.0), (-200.0, -100.0), -180.0, says="I start."),
    Version(policy(gain=2.0), (-90.0,), -95.0, failed=(0,)),
]
ROW = {"t": 0, "obs": [0.1], "action": 1, "reward": -1.0, "terminated": False, "truncated": False, "info": {}}
TEXTS = ["", "\0", "\x1b[2J\x07", "<script>", "=cmd|'/C calc'!A0"]
TEXTS += ["../../x", "/etc/passwd", "a" * 5000, "a\nb"]
NUMBERS = [*words('NaN -Infinity 1e400 1e308 -1 null true "x" [] {}'), "9" * 400, "9" * 5000]
NUMBERS += ['"\\ud800"', "[" * 3000 + "]" * 3000, "-9223372036854775809", "1e-400"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = write_run(tmp_path_factory.mktemp("whole"), VERSIONS, heldout=[-95.0] * 32)
    for submit, n in ((0, 2), (1, 1)):
        for episode in range(n):
            episodes = run / f"workspace/feedback/submit_{submit:03d}/episodes"
            folder = episodes / f"ep_{2 * submit + episode:03d}"
            folder.mkdir(parents=True)
            (folder / "trajectory.jsonl").write_text(json.dumps(ROW) + "\n")
    return run


class _Nowhere:
    """A tracker that keeps nothing."""

    def n_known(self, curve: tracking.Curve) -> int:
        return 0

    def add(self, curve: tracking.Curve, points: list[tracking.Point]) -> None:
        assert curve.settings()

    def close(self) -> None:
        pass


def _report(run: Path, whole: Path) -> None:
    loaded = load_runs([run])
    assert len(loaded.runs) + len(loaded.left_out) == 1
    assert all(left.reason for left in loaded.left_out)


def _verify(run: Path, whole: Path) -> None:
    found = read_run(run)
    list(numbers.differences(found, None))
    for played in found.train:
        for folder in played.folders:
            try:
                compare.actions_of(compare.Rows(folder))
            except (OSError, ValueError):
                continue


def _export(run: Path, whole: Path) -> None:
    out = run.parents[3] / "out"
    out.mkdir(exist_ok=True)
    runs = load_public_runs(run)
    tables.write_csv(runs, out)
    transcripts.write_atif(runs, out)
    transcripts.write_inspect(runs, out)
    assert runs._repr_html_()


def _web(run: Path, whole: Path) -> None:
    reader = FolderReader([run.parents[2]])
    for facts in reader.read_runs(None, cluster_is_known=True).by_key.values():
        assert facts.path is not None
        detail = Detail(facts.path)
        for submit in reader.submits(facts.path):
            index = submit.summary.submit_index
            detail.code(index, checkpoints=True)
            detail.summary(index)
            for episode in detail.episodes(index):
                try:
                    detail.played(detail.episode_files(index, episode)[0])
                except NotThereError:
                    continue
        detail.messages()
        detail.happened()


def _harbor(run: Path, whole: Path) -> None:
    with contextlib.suppress(OSError):  # its answer to Harbor is the error
        scores._score(RunFolder(run))


READERS: dict[str, Callable[[Path, Path], object]] = {
    "report": _report,
    "verify": _verify,
    "rescore": lambda run, _: read_finished([run]),
    "publish": lambda run, _: find_runs([run]),
    "diff": lambda run, whole: [differences(whole, run), differences(run, whole)],
    "export": _export,
    "track": lambda run, _: list(tracking.track([run], _Nowhere(), follow=False)),
    "web": _web,
    "harbor": _harbor,
}


class HungError(BaseException):
    """No `except Exception` of a reader catches it."""


@pytest.fixture(autouse=True)
def patience() -> Iterator[None]:
    def end(number: int, frame: object) -> None:
        raise HungError

    before = signal.signal(signal.SIGALRM, end)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def read(name: str, run: Path, whole: Path) -> None:
    signal.alarm(60)
    try:
        with contextlib.suppress(EvopolicyError):
            READERS[name](run, whole)
    finally:
        signal.alarm(0)


def copy(whole: Path, target: Path) -> Path:
    run: Path = target / "runs" / "agent" / "gym_acrobot" / "exp"
    shutil.copytree(whole, run)
    for path in run.rglob("*"):
        path.chmod(0o755)
    return run


def _sparse(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(1 << 40)


def _link(target: str) -> Callable[[Path], None]:
    def replace(path: Path) -> None:
        path.unlink()
        path.symlink_to(target)

    return replace


REPLACEMENTS: dict[str, Callable[[Path], object]] = {
    "a pipe": lambda path: [path.unlink(), os.mkfifo(path)],
    "a folder": lambda path: [path.unlink(), path.mkdir()],
    "a link to a device without end": _link("/dev/zero"),
    "a link to itself": _link("run.json"),
    "a file without end": _sparse,
    "nothing": lambda path: path.write_bytes(b""),
    "lists without end": lambda path: path.write_bytes(b"[" * 100_000),
    "objects without end": lambda path: path.write_bytes(b'{"a":' * 100_000),
}


@pytest.mark.parametrize("kind", REPLACEMENTS)
def test_nothing_in_place_of_a_file_stops_or_breaks_a_reader(whole: Path, tmp_path: Path, kind: str) -> None:
    # One file of each name.
    names = {path.name: path.relative_to(whole) for path in sorted(whole.rglob("*")) if path.is_file()}
    assert names.keys() >= set(words("run.json summary.json _meta.json trajectory.jsonl agent.jsonl"))
    for number, name in enumerate(names.values()):
        run = copy(whole, tmp_path / str(number))
        REPLACEMENTS[kind](run / name)
        for reader in READERS:
            read(reader, run, whole)


def damage(path: Path, rng: random.Random) -> None:
    """Another value in one place of a JSON document, or other bytes."""
    if path.suffix == ".json" and rng.random() < 0.8:
        document = json.loads(path.read_bytes())
        holder = document
        while True:
            keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
            key = rng.choice(keys)
            if not (isinstance(holder[key], dict | list) and holder[key]) or rng.random() < 0.2:
                break
            holder = holder[key]
        holder[key] = "@@"
        new = rng.choice([*NUMBERS, *map(json.dumps, TEXTS)])
        if isinstance(holder, dict) and rng.random() < 0.2:
            new = f"0, {json.dumps(key)}: {new}"  # a field twice
        path.write_text(json.dumps(document).replace('"@@"', new))
        return
    data = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 9) if data else 0):
        data[rng.randrange(len(data))] = rng.choice([0, 10, 34, 92, 128, 214, rng.randrange(256)])
    path.write_bytes(data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data)


@pytest.mark.parametrize("seed", range(40))
def test_damaged_files_are_refused_or_change_nothing(whole: Path, tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    run = copy(whole, tmp_path)
    files = sorted(path for path in run.rglob("*") if path.is_file())
    records = [path for path in files if path.suffix == ".json"]
    damage(rng.choice(records if rng.random() < 0.7 else files), rng)
    for reader in READERS:
        read(reader, run, whole)


@pytest.mark.parametrize(
    "place", ["workspace", "workspace/feedback", "checkpoints", "checkpoints/submit_001", "logs"]
)
def test_no_folder_that_is_a_link_is_read(whole: Path, tmp_path: Path, place: str) -> None:
    """A report would quote the sources that it finds behind the link."""
    run = copy(whole, tmp_path)
    shutil.move(run / place, tmp_path / "elsewhere")
    (run / place).symlink_to(tmp_path / "elsewhere")
    (found,) = load_runs([run]).left_out
    assert "outside the run directory" in found.reason or "is a link" in found.reason, found.reason
    if place.count("/") == 0:
        with pytest.raises(ConfigError, match="outside the run directory"):
            read_run(run)


def test_of_several_spellings_of_a_submit_the_usual_one_is_read(tmp_path: Path) -> None:
    for name in ("submit_1", "submit_0001", "submit_001", "submit_٣٣٣", "submit_0000000001"):
        (tmp_path / name).mkdir()
    (tmp_path / "submit_002").symlink_to(tmp_path / "submit_001")
    found = read_submits(tmp_path.parent, Artifacts(checkpoints=tmp_path.name))
    assert [one.checkpoint for one in found] == [tmp_path / "submit_001"]


def test_an_error_names_the_file_the_reason_and_the_remedy(tmp_path: Path) -> None:
    for name, make, reason in (
        ("link", lambda path: path.symlink_to("/etc/passwd"), "put the file itself in its place"),
        ("folder", Path.mkdir, "not a regular file"),
        ("large", lambda path: [path.touch(), _sparse(path)], "larger than 67,108,864 bytes"),
    ):
        make(tmp_path / name)  # type: ignore[operator]
        with pytest.raises(OSError, match=reason) as caught:
            read_regular(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)


def test_arrays_that_unpack_to_more_than_allowed_are_not_unpacked() -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": "|u1", "fortran_order": False, "shape": (1 << 24,)}
        )
        archive.writestr("observations.npy", header.getvalue() + bytes(1 << 24))
    assert len(packed.getvalue()) < 1 << 19
    with pytest.raises(ValueError, match="unpack to"):
        read_arrays(packed.getvalue(), 1 << 20)
    shape = io.BytesIO()
    np.lib.format.write_array_header_1_0(shape, {"descr": "<f8", "fortran_order": False, "shape": (1 << 50,)})
    pickled = io.BytesIO()
    np.save(pickled, np.array([{}], dtype=object), allow_pickle=True)
    for data in (shape.getvalue(), pickled.getvalue(), b"", b"PK\3\4", b"\x93NUMPY"):
        with pytest.raises(ValueError, match=r"."):
            read_arrays(data, 1 << 20)


@pytest.mark.parametrize("value", ['"\\ud800"', "NaN", "1e400", "Infinity"])
def test_a_published_record_with_impossible_values_is_left_out(tmp_path: Path, value: str) -> None:
    run = write_published_run(tmp_path)
    text = json.dumps(json.loads((run / "run.json").read_text()) | {"model": "@"}).replace('"@"', value)
    (run / "run.json").write_text(text)
    with pytest.raises(ProtocolError):
        published.read_record(run, text.encode())
    (found,) = load_runs([tmp_path]).left_out
    assert found.reason.startswith("run.json: not a run record"), found.reason


def test_the_untouched_run_is_read_by_all(whole: Path, tmp_path: Path) -> None:
    run = copy(whole, tmp_path)
    for name, reader in READERS.items():
        if name == "publish":  # no coordinator committed to it
            with pytest.raises(ConfigError, match="names no commitment"):
                reader(run, whole)
        else:
            reader(run, whole)
    assert load_runs([run]).runs
    assert msgspec.json.decode(encode_run_record(read_run(run).record))
