"""Runs in experiment trackers: TensorBoard, MLflow, Weights & Biases.

Rules that this module owns:
- While a run is open, only what its agent sees is sent: the summaries of its submits. Hidden scores follow when
  `run.json` is there.
- A metric's step is the number of train episodes charged so far, so that runs are compared by budget.
- A tracker remembers how many submits of a run it has, so an export that is repeated or goes on after a stop adds only
  what is missing.
"""

from __future__ import annotations

import hashlib
import math
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import urlsplit

import msgspec

from evopolicy._exports.tables import time_of
from evopolicy._runs import summaries_of
from evopolicy_common.errors import DECODE_ERRORS, ConfigError, ProtocolError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_files import RUN_JSON, no_run_below, read_record, run_folders
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import INDEX, Index
from evopolicy_common.records.summary import Summary
from evopolicy_common.regular_files import read_regular

POLL_S = 2.0
_KNOWN = "evopolicy.json"


class Curve(NamedTuple):
    """A run, open or finished."""

    folder: Path
    record: RunRecord | None
    """None while it is open."""
    summaries: list[Summary]
    """Of its submits so far."""

    @property
    def name(self) -> str:
        """Entry, environment and experiment: the last three parts of its folder."""
        return "/".join(self.folder.parts[-3:])

    @property
    def id(self) -> str:
        """Identifies it in a tracker, also in a later call: 32 hexadecimal digits.

        A run that replaces another in its folder (`--overwrite`) has another one.
        """
        begun = self.summaries[0].submit_started_at if self.summaries else ""
        return hashlib.sha256(f"{self.folder} {begun}".encode()).hexdigest()[:32]

    @property
    def n_known(self) -> int:
        """As `Tracker.n_known`, once all of it was added."""
        return len(self.summaries) if self.record is None else -1

    @property
    def completed(self) -> bool:
        return self.record is not None and self.record.outcome.status == "completed"

    def settings(self) -> dict[str, str]:
        """Known from the start: entry, environment, and once it is finished the experiment's settings."""
        entry, env, experiment = self.folder.parts[-3:]
        settings = {"entry": entry, "env": env.replace("_", "/", 1), "experiment": experiment}
        if self.record is not None:
            settings |= {"entry": self.record.agent.entry, "env": self.record.env, "model": self.record.model}
            settings |= {"repeat": str(self.record.repeat), "status": self.record.outcome.status}
            dimensions = msgspec.to_builtins(self.record.experiment_dimensions).items()
            settings |= {name: str(value) for name, value in dimensions if isinstance(value, str | int)}
        return settings


class Point(NamedTuple):
    """Metrics at one step."""

    step: int
    """Train episodes charged so far."""
    time_s: float
    """Unix time."""
    metrics: dict[str, float]


class Tracker(Protocol):
    """The destination of metrics."""

    def n_known(self, curve: Curve) -> int:
        """Number of submits of this run that it has; -1 when it has the whole run."""

    def add(self, curve: Curve, points: list[Point]) -> None:
        """Adds metrics, and the settings of a finished run."""

    def close(self) -> None:
        """Writes the remaining data."""


def track(paths: list[Path], tracker: Tracker, *, follow: bool) -> Iterator[str]:
    """Sends runs to a tracker, and yields the name of each that is finished.

    With `follow` it continues until every run below the paths, and every run of a sweep whose folder is given, is
    finished; the first may appear later. Raises ConfigError when there is no run and `follow` is off, and for a damaged
    record.
    """
    done: set[Path] = set()
    try:
        while True:
            awaited = _awaited(paths)
            folders = run_folders(path for path in paths if path.exists())[0]
            if not folders and not follow:
                raise ConfigError(no_run_below(*paths))
            for folder in folders:
                if folder in done:
                    continue
                curve = _curve(folder)
                _send(curve, tracker)
                if curve.record is not None:
                    done.add(folder)
                    yield curve.name
            if not follow or (folders and len(done) == len(folders) and not awaited):
                return
            time.sleep(POLL_S)
    finally:
        tracker.close()


def _awaited(paths: list[Path]) -> bool:
    """Whether a sweep in one of these folders has runs that are not finished."""
    for path in paths:
        try:
            index = msgspec.json.decode(read_regular(path / INDEX), type=Index)
        except FileNotFoundError:
            continue
        except (OSError, *DECODE_ERRORS) as error:
            raise ConfigError(f"{path / INDEX} cannot be read: {error}") from error
        if any(one.state in ("pending", "running") for one in index.runs.values()):
            return True
    return False


def _send(curve: Curve, tracker: Tracker) -> None:
    if curve.n_known == 0 or (known := tracker.n_known(curve)) < 0:
        return
    seen, hidden = _points(curve)
    if points := seen[known:] + hidden:
        tracker.add(curve, points)


def _points(curve: Curve) -> tuple[list[Point], list[Point]]:
    """A point for each submit, and the hidden scores of a finished run: each validation score at its submit, the
    held-out score at the end."""
    record = curve.record
    ended = 0.0 if record is None else time_of(record.timing.end_time).timestamp()
    scores = (record.outcome.val_scores if record is not None else None) or {}
    seen: list[Point] = []
    hidden: list[Point] = []
    spent = 0
    for one in curve.summaries:
        spent += one.n_episodes
        metrics = {
            "train/mean_return": one.mean_return,
            "train/std_return": one.std_return,
            "train/min_return": one.min_return,
            "train/max_return": one.max_return,
            "train/mean_length": one.mean_episode_length,
            "train/failed_episodes": None if one.errors is None else len(one.errors),
            "submit/ok": float(one.status == "ok"),
            "submit/wall_s": one.wall_time_seconds,
            "budget/remaining": one.remaining_budget,
        }
        seen.append(Point(spent, time_of(one.submit_completed_at).timestamp(), _finite(metrics)))
        if (score := scores.get(str(one.submit_index))) is not None:
            hidden.append(Point(spent, ended, _finite({"validation/mean_return": score})))
    if record is not None:
        outcome, tokens = record.outcome, record.agent.tokens
        metrics = {"heldout/mean_return": outcome.score, "random/mean_return": outcome.random_score}
        if tokens is not None:
            metrics |= {"agent/output_tokens": tokens.output, "agent/cost_usd": tokens.cost}
        hidden.append(Point(spent, ended, _finite(metrics)))
    return seen, hidden


def _finite(metrics: dict[str, float | None]) -> dict[str, float]:
    known = {name: float(value) for name, value in metrics.items() if value is not None}
    return {name: value for name, value in known.items() if math.isfinite(value)}


def _curve(folder: Path) -> Curve:
    try:
        record = read_record(folder) if os.path.lexists(folder / RUN_JSON) else None
        return Curve(folder, record, summaries_of(folder))
    except (ProtocolError, OSError) as error:
        raise ConfigError(f"{folder}: {error}") from error


class _Known(msgspec.Struct, frozen=True):
    """The state of a run's export, stored beside a tracker's own files."""

    run: str
    """`Curve.id`."""
    submits: int
    """As `Tracker.n_known`."""


def _read_known(path: Path) -> _Known:
    try:
        return msgspec.json.decode(path.read_bytes(), type=_Known)
    except FileNotFoundError:
        return _Known(run="", submits=0)
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path} is damaged: {error}; choose another --out") from error


class _Files:
    """A tracker that writes below `out` and cannot be asked: a file of ours has the number of a run's submits."""

    def __init__(self, out: str) -> None:
        self._out = Path(out)
        self._open: dict[str, Any] = {}

    def _known(self, curve: Curve) -> Path:
        return self._out / "evopolicy" / f"{curve.id}.json"

    def n_known(self, curve: Curve) -> int:
        return _read_known(self._known(curve)).submits

    def _save_known(self, curve: Curve) -> None:
        path = self._known(curve)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, msgspec.json.encode(_Known(run=curve.id, submits=curve.n_known)))


class TensorBoard(_Files):
    """Event files, one folder a run, below `out`."""

    def _known(self, curve: Curve) -> Path:
        """Beside the events, in a folder named as the run; with a part of its id where another run of that name was."""
        usual = self._out / curve.name
        own = _read_known(usual / _KNOWN).run in ("", curve.id)
        return (usual if own else usual.with_name(f"{usual.name}-{curve.id[:8]}")) / _KNOWN

    def add(self, curve: Curve, points: list[Point]) -> None:
        """Appends scalars to the run's event file."""
        from tensorboardX import SummaryWriter

        if curve.id not in self._open:
            folder = self._known(curve).parent
            self._open[curve.id] = SummaryWriter(str(folder))
            # tensorboardX puts the host's name at the end of the file's.
            host = f".{socket.gethostname()}"
            for path in folder.glob("events.out.tfevents.*"):
                if path.name.endswith(host):
                    path.rename(path.with_name(path.name.removesuffix(host)))
        writer = self._open[curve.id]
        for point in points:
            for name, value in point.metrics.items():
                writer.add_scalar(name, value, point.step, walltime=point.time_s)
        if curve.record is not None:
            table = "".join(f"| {name} | {value} |\n" for name, value in curve.settings().items())
            writer.add_text("settings", "| setting | value |\n|---|---|\n" + table)
        writer.flush()
        self._save_known(curve)
        if curve.record is not None:
            self._open.pop(curve.id).close()

    def close(self) -> None:
        """Closes the files of runs that are still open."""
        while self._open:
            self._open.popitem()[1].close()


class MLflow:
    """Runs of an MLflow experiment named `evopolicy`, or by MLFLOW_EXPERIMENT_NAME."""

    def __init__(self, out: str) -> None:
        if urlsplit(out).scheme in ("", "file") and out != "databricks":
            raise ConfigError(
                f"--out {out} is a folder, and MLflow keeps no runs in folders: name a database, such as"
                " --out sqlite:///mlflow.db, or a server, such as --out http://HOST:5000"
            )
        # Without it, a local database names a folder of this machine as the place of artifacts, of which there are
        # none.
        os.environ.setdefault("_MLFLOW_SERVER_ARTIFACT_ROOT", "mlflow-artifacts:/")
        from mlflow import MlflowClient

        self._client = MlflowClient(tracking_uri=out)
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", "evopolicy")
        experiment = self._client.get_experiment_by_name(name)
        self._experiment = experiment.experiment_id if experiment else self._client.create_experiment(name)
        self._runs: dict[str, Any] = {}

    def n_known(self, curve: Curve) -> int:
        """From the run's tag `evopolicy.submits`."""
        if curve.id not in self._runs:
            matches = self._client.search_runs([self._experiment], f"tags.`evopolicy.id` = '{curve.id}'")
            self._runs[curve.id] = matches[0] if matches else None
        run = self._runs[curve.id]
        return 0 if run is None else int(run.data.tags.get("evopolicy.submits", 0))

    def add(self, curve: Curve, points: list[Point]) -> None:
        """Logs metrics, and parameters once the run is finished."""
        from mlflow.entities import Metric, Param, RunTag

        run = self._runs[curve.id]  # `n_known` was asked before
        if run is None:
            tags = {"evopolicy.id": curve.id}
            run = self._client.create_run(self._experiment, run_name=curve.name, tags=tags)
        params = [Param(name, value) for name, value in curve.settings().items()] if curve.record else []
        metrics = [
            Metric(name, value, int(1000 * point.time_s), point.step)
            for point in points
            for name, value in point.metrics.items()
        ]
        # A batch of the server holds at most 1,000 metrics.
        for first in range(0, len(metrics), 900):
            self._client.log_batch(run.info.run_id, metrics=metrics[first : first + 900])
        tag = RunTag("evopolicy.submits", str(curve.n_known))
        self._client.log_batch(run.info.run_id, params=params, tags=[tag])
        if curve.record is not None:
            self._client.set_terminated(run.info.run_id, "FINISHED" if curve.completed else "FAILED")
        self._runs[curve.id] = self._client.get_run(run.info.run_id)

    def close(self) -> None:
        """Nothing remains to be written."""


class WeightsAndBiases(_Files):
    """Runs of a project named `evopolicy`, or by WANDB_PROJECT. WANDB_MODE=offline writes below `out` only."""

    def add(self, curve: Curve, points: list[Point]) -> None:
        """Logs metrics over `budget/spent`, and the settings."""
        import wandb

        if curve.id not in self._open:
            off = dict.fromkeys(
                ("disable_git", "x_disable_stats", "x_disable_meta", "x_disable_machine_info"), True
            )
            names = dict.fromkeys(("host", "program", "x_executable"), "evopolicy")
            self._open[curve.id] = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "evopolicy"),
                id=curve.id,
                name=curve.name,
                group=curve.folder.parts[-2],
                dir=str(self._out),
                resume="allow",
                reinit="create_new",
                settings=wandb.Settings(console="off", silent=True, **off, **names),
            )
            self._open[curve.id].define_metric("*", step_metric="budget/spent")
        run = self._open[curve.id]
        run.config.update(curve.settings(), allow_val_change=True)
        for point in points:
            run.log(point.metrics | {"budget/spent": point.step})
        self._save_known(curve)
        if curve.record is not None:
            self._open.pop(curve.id).finish(exit_code=0 if curve.completed else 1)

    def close(self) -> None:
        """Ends the connections of runs that are still open; a later call resumes them."""
        while self._open:
            self._open.popitem()[1].finish()
