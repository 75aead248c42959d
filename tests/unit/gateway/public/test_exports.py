"""Runs in the formats of other tools, each read back with the tool's own library."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from invented import run_dirs
from invented.policies import Version
from invented.run_dirs import write_run
from program_runs import run_program

from evopolicy import load_runs
from evopolicy._exports import tracking
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_gateway.suite.suite_index import save

pytestmark = pytest.mark.system

VERSIONS = [
    Version({"policy.py": "x = 1"}, (1.0, 2.0), 0.5),
    Version({"policy.py": "x = 2"}, (3.0, 5.0), 2.5),
    Version({"policy.py": "x ="}, (0.0,), None, status="import_error"),
]
SPENT = [2, 4, 5]
"""Episodes charged after each submit."""


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    write_run(tmp_path / "runs", VERSIONS, heldout=(4.0, 6.0), random_mean=-7.0)
    return tmp_path / "runs"


def export(*words: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command, as a user calls it."""
    known = {"WANDB_MODE": "offline", "MLFLOW_DISABLE_TELEMETRY": "true"}
    program = Path(sys.executable).with_name("evopolicy")
    return run_program(program, "export", *words, timeout=300, env=os.environ | known | environment)


def exported(*words: str | Path, **environment: str) -> str:
    """The stderr of the command, which succeeds."""
    done = export(*words, **environment)
    assert done.returncode == 0, done.stderr
    return done.stderr


ROW = {"t": 0, "obs": [1.0], "action": 1, "reward": 1.5, "terminated": True, "truncated": False, "info": {}}
OUT = {"mlflow": "sqlite:///{}/out/mlflow.db"}


@pytest.mark.parametrize(
    "kind", ["csv", "parquet", "tensorboard", "mlflow", "wandb", "minari", "atif", "inspect"]
)
def test_no_export_names_a_path_the_host_or_the_user(kind: str, tmp_path: Path) -> None:
    run = write_run(tmp_path / "runs", VERSIONS)
    write_episode(run, 0, 0, [ROW])
    (run / "logs").mkdir(exist_ok=True)
    (run / "logs" / "agent.jsonl").write_text('{"type": "prompt", "text": "go"}\n')
    (tmp_path / "out").mkdir()
    to = OUT.get(kind, "{}/out").format(tmp_path)
    user = "zaphod.beeblebrox"
    exported(tmp_path / "runs", "--to", kind, "--out", to, LOGNAME=user, USER=user)
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert files
    host = socket.gethostname()
    # A host's name may be as short as two letters, which any bytes contain.
    is_host = re.compile(rb"(?<![A-Za-z0-9])" + re.escape(host.encode()) + rb"(?![A-Za-z0-9])")
    for path in files:
        if path.suffix == ".log":
            continue  # wandb's own, which it never uploads
        data = path.read_bytes()
        if path.suffix == ".eval":
            with zipfile.ZipFile(path) as archive:
                data = b"".join(map(archive.read, archive.namelist()))
        for text in (str(tmp_path), user, sys.prefix, str(Path(__file__).parents[4])):
            assert text.encode() not in data, (path, text)
        assert not is_host.search(data), path
        assert host not in path.name.split("."), path


def test_csv_holds_every_record_and_no_formula(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", VERSIONS, entry=" =HYPERLINK(1)")
    exported(tmp_path / "runs", "--to", "csv", "--out", tmp_path / "tables")
    rows: dict[str, list[dict[str, str]]] = {}
    for name in ("runs", "submits", "episodes"):
        lines = (tmp_path / "tables" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        rows[name] = list(csv.DictReader(lines))
    assert [row["entry"] for row in rows["runs"]] == ["' =HYPERLINK(1)"]
    assert [row["mean_return"] for row in rows["submits"]] == ["1.5", "4.0", ""]
    train = [row["episode_return"] for row in rows["episodes"] if row["split"] == "train"]
    assert train == ["1.0", "2.0", "3.0", "5.0"]


def test_parquet_has_the_types_of_the_records(runs: Path, tmp_path: Path) -> None:
    from pyarrow import parquet

    exported(runs, "--to", "parquet", "--out", tmp_path)
    episodes = parquet.read_table(tmp_path / "episodes.parquet")
    assert str(episodes.schema.field("episode_return").type) == "double"
    assert str(episodes.schema.field("case").type) == "int64"
    assert not episodes.schema.field("split").nullable
    assert episodes.column("episode_return").to_pylist() == [1.0, 2.0, 3.0, 5.0, 4.0, 6.0]
    selected = parquet.read_table(tmp_path / "submits.parquet").column("selected")
    assert selected.to_pylist() == [False, True, False]


def scalars(out: Path) -> dict[str, list[tuple[int, float]]]:
    """Every scalar of the only run below `out`, by step, as TensorBoard reads it."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (folder,) = {path.parent for path in out.rglob("events.out.tfevents.*")}
    events = EventAccumulator(str(folder)).Reload()
    return {
        name: [(one.step, one.value) for one in events.Scalars(name)] for name in events.Tags()["scalars"]
    }


def test_tensorboard_reads_returns_over_the_budget_once(runs: Path, tmp_path: Path) -> None:
    for _ in range(2):
        exported(runs, "--to", "tensorboard", "--out", tmp_path / "events")
    curves = scalars(tmp_path / "events")
    assert curves["train/mean_return"] == [(2, 1.5), (4, 4.0)]
    assert curves["submit/ok"] == [(2, 1.0), (4, 1.0), (5, 0.0)]
    assert curves["validation/mean_return"] == [(2, 0.5), (4, 2.5)]
    assert curves["heldout/mean_return"] == [(5, 5.0)]
    assert curves["random/mean_return"] == [(5, -7.0)]


def test_runs_of_one_name_have_curves_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def n_curves() -> int:
        exported(tmp_path / "a", tmp_path / "b", "--to", "tensorboard", "--out", tmp_path / "events")
        return len({path.parent for path in (tmp_path / "events").rglob("events.out.tfevents.*")})

    for place in ("a", "b"):
        write_run(tmp_path / place, VERSIONS)
    assert n_curves() == 2
    assert n_curves() == 2
    shutil.rmtree(tmp_path / "b")
    monkeypatch.setattr(run_dirs, "START", run_dirs.START + 1000)
    write_run(tmp_path / "b", VERSIONS)
    assert n_curves() == 3


def test_submits_of_a_budget_with_four_digits_are_found(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", VERSIONS, budget=1000)
    assert [one.mean_return for one in load_runs(tmp_path / "runs").submits()] == [1.5, 4.0, None]
    exported(tmp_path / "runs", "--to", "tensorboard", "--out", tmp_path / "events")
    assert scalars(tmp_path / "events")["train/mean_return"] == [(2, 1.5), (4, 4.0)]


def test_mlflow_has_each_run_once_with_its_settings(runs: Path, tmp_path: Path) -> None:
    from mlflow import MlflowClient

    uri = f"sqlite:///{tmp_path}/mlflow.db"
    for _ in range(2):
        exported(runs, "--to", "mlflow", "--out", uri)
    client = MlflowClient(tracking_uri=uri)
    experiment = client.get_experiment_by_name("evopolicy")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params["env"] == "gym/acrobot"
    history = client.get_metric_history(run.info.run_id, "train/mean_return")
    assert [(one.step, one.value) for one in history] == [(2, 1.5), (4, 4.0)]


def records_of(file: Path) -> Iterator[bytes]:
    """The records of a `.wandb` file: LevelDB's log format, blocks of 32 KiB, behind a header of seven bytes."""
    data, at, whole = file.read_bytes(), 7, b""
    while at + 7 <= len(data):
        if at % 32_768 > 32_768 - 7:
            at += 32_768 - at % 32_768
            continue
        _, length, kind = struct.unpack_from("<IHB", data, at)
        whole += data[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # the only part, or the last
            yield whole
            whole = b""


def test_wandb_records_offline(runs: Path, tmp_path: Path) -> None:
    from wandb.proto import wandb_internal_pb2

    for _ in range(2):
        exported(runs, "--to", "wandb", "--out", tmp_path)
    (file,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    rows = []
    for data in records_of(file):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        items = record.history.item if record.HasField("history") else ()
        rows.append({one.key or one.nested_key[0]: json.loads(one.value_json) for one in items})
    means = [(row["budget/spent"], row["train/mean_return"]) for row in rows if "train/mean_return" in row]
    assert means == [(2, 1.5), (4, 4.0)]
    assert [row["heldout/mean_return"] for row in rows if "heldout/mean_return" in row] == [5.0]


def write_episode(run: Path, submit: int, episode: int, rows: list[dict[str, Any]]) -> None:
    folder = run / "workspace" / "feedback" / f"submit_{submit:03d}" / "episodes" / f"ep_{episode:03d}"
    folder.mkdir(parents=True)
    (folder / "trajectory.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_minari_reads_episodes_with_their_observations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import minari
    import numpy as np

    run = write_run(tmp_path / "runs", VERSIONS[:2])
    for submit in range(2):
        for episode in range(2):
            seen = [{"position": [float(submit), t / 2], "mission": "go"} for t in range(3)]
            rows = [{"t": t, "obs": obs, "action": (t + episode) % 3} for t, obs in enumerate(seen)]
            rows = [{**ROW, "terminated": False, **row} for row in rows]
            rows[0]["reward"], rows[2]["terminated"] = "-Inf", True
            write_episode(run, submit, episode, rows)
    assert "Warning" not in exported(tmp_path / "runs", "--to", "minari", "--out", tmp_path / "sets")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    dataset = minari.load_dataset("evopolicy/gym-acrobot/Agent-A-v0")
    episodes = list(dataset.iterate_episodes())
    assert len(episodes) == 4
    last = episodes[3]
    np.testing.assert_array_equal(last.observations["position"], [[1, 0], [1, 0.5], [1, 1], [1, 1]])
    assert last.observations["mission"] == ["go"] * 4
    np.testing.assert_array_equal(last.actions, [1, 2, 0])
    assert list(last.rewards) == [-np.inf, 1.5, 1.5]
    assert list(last.terminations) == [False, False, True]
    metadata = next(iter(dataset.storage.get_episode_metadata([3])))
    assert (metadata["submit"], metadata["case"], metadata["episode_return"]) == (1, 1, 5.0)
    again = export(tmp_path / "runs", "--to", "minari", "--out", tmp_path / "sets")
    assert again.returncode == 2
    assert "is there already" in again.stderr


def test_steps_of_an_episode_are_read_one_by_one(tmp_path: Path) -> None:
    import tracemalloc

    from evopolicy._exports.trajectories import _columns, _rows

    path, steps = tmp_path / "trajectory.jsonl", 2_000
    row = {"obs": {"v": [t / 7 for t in range(200)]}, "action": 1, "reward": 1, "terminated": False}
    path.write_text((json.dumps({**row, "truncated": False, "info": {"x": ["y"] * 200}}) + "\n") * steps)
    tracemalloc.start()
    try:
        rows = list(_rows(path))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < path.stat().st_size
    assert _columns([each.obs for each in rows])["v"].shape == (steps, 200)


def test_minari_leaves_out_odd_episodes_and_keeps_each_with_its_own_facts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import minari

    four = Version({"policy.py": "x = 1"}, (1.0, 2.0, 3.0, 4.0), 0.5)
    run = write_run(tmp_path / "runs", [four])
    for episode, action in enumerate([None, 1, [[0], 1], 2]):
        write_episode(run, 0, episode, [{**ROW, "obs": [1.0, 2.0], "action": action}])
    # As an episode whose trajectory did not fit.
    (run / "workspace/feedback/submit_000/episodes/ep_001/trajectory.jsonl").unlink()
    said = exported(tmp_path / "runs", "--to", "minari", "--out", tmp_path / "sets").splitlines()
    assert [line.partition(": left out")[0][-9:] for line in said] == ["episode 0", "episode 2"]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    dataset = minari.load_dataset("evopolicy/gym-acrobot/Agent-A-v0")
    (metadata,) = dataset.storage.get_episode_metadata([0])
    assert (dataset.total_episodes, metadata["case"], metadata["episode_return"]) == (1, 3, 4.0)


def test_minari_keeps_entries_apart_whose_letters_it_cannot_name(tmp_path: Path) -> None:
    for entry in ("模型甲", "模型乙"):
        run = write_run(tmp_path / "runs" / entry, VERSIONS[:1], entry=entry)
        write_episode(run, 0, 0, [ROW])
    exported(tmp_path / "runs", "--to", "minari", "--out", tmp_path / "sets")
    names = [path.name for path in (tmp_path / "sets/evopolicy/gym-acrobot").glob("*-v0")]
    assert [bool(re.fullmatch("x-[0-9a-f]{8}-v0", name)) for name in names] == [True, True], names


def test_a_sweep_is_followed_to_its_end_and_shows_nothing_hidden_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracking, "POLL_S", 0.05)
    runs = tmp_path / "runs"
    entry = SweepRun(name="a", agent="Agent A", env="gym/acrobot", repeat=0, digest="0" * 64, state="running")
    save(runs, Index(suite="s", runs={"a": entry}))
    run = write_run(runs, VERSIONS, heldout=(4.0, 6.0))
    (run / "logs").mkdir(exist_ok=True)
    finished = (run / "run.json").read_bytes()
    (run / "run.json").unlink()
    kept: list[tuple[list[tracking.Point], bool]] = []
    first = threading.Event()

    class Kept:
        """Keeps what arrives."""

        def n_known(self, curve: tracking.Curve) -> int:
            return sum(1 for points, _ in kept for point in points if "submit/ok" in point.metrics)

        def add(self, curve: tracking.Curve, points: list[tracking.Point]) -> None:
            kept.append((points, curve.record is not None))
            first.set()

        def close(self) -> None:
            kept.append(([], True))

    ended: list[str] = []
    follower = threading.Thread(target=lambda: ended.extend(tracking.track([runs], Kept(), follow=True)))
    follower.start()
    assert first.wait(60)
    assert [point.step for points, _ in kept for point in points] == SPENT
    names = {name for points, _ in kept for point in points for name in point.metrics}
    assert not [name for name in names if name.startswith(("val", "held"))]
    write_atomically(run / "run.json", finished)
    save(runs, Index(suite="s", runs={"a": msgspec.structs.replace(entry, state="completed")}))
    follower.join(60)
    assert not follower.is_alive()
    assert ended == ["/".join(run.parts[-3:])]
    assert [point.metrics for point in kept[1][0]][-1]["heldout/mean_return"] == 5.0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("nowhere", "--to", "csv"), "nowhere"),
        (("nowhere", "--to", "tensorboard"), "no run directory at or below"),
        (("nowhere", "--to", "csv", "--follow"), "--follow: csv"),
        (("{runs}", "--to", "mlflow", "--out", "nosuch://x"), "--to mlflow"),
        (("{runs}", "--to", "mlflow", "--out", "mlruns"), "sqlite:///mlflow.db"),
        (("{runs}", "--to", "mlflow", "--out", "file:///tmp/x"), "--out file:///tmp/x is a folder"),
    ],
)
def test_wrong_calls_say_what_is_wrong(runs: Path, words: tuple[str, ...], expected: str) -> None:
    done = export(*(word.format(runs=runs) for word in words))
    assert done.returncode == 2, done.stderr
    assert expected in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_library_is_named_with_its_extra(runs: Path, tmp_path: Path) -> None:
    text = "raise ModuleNotFoundError(\"No module named 'pyarrow'\", name='pyarrow')"
    (tmp_path / "pyarrow.py").write_text(text)
    done = export(runs, "--to", "parquet", "--out", tmp_path / "t", PYTHONPATH=str(tmp_path))
    assert done.returncode == 2
    assert "[export]'" in done.stderr
