"""Finished runs, read from their folders as typed records."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from evopolicy._arguments import check_argument
from evopolicy._records import Records, bars
from evopolicy_common.errors import DECODE_ERRORS, ConfigError, ProtocolError
from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.records.run_files import no_run_below, read_record, run_folders
from evopolicy_common.records.run_record import RunRecord, RunSummary
from evopolicy_common.records.summary import Summary
from evopolicy_common.regular_files import open_regular
from evopolicy_gateway.agents.function import RESULT

_MAX_RESULT_BYTES = 1 << 20
_MAX_SHOWN_VIDEO_BYTES = 4 << 20


class SubmitRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One row per submit."""

    run: str
    env: str
    entry: str
    submit: int
    """Index, from 0."""
    status: str
    """`ok`, or why not, such as `import_error`."""
    n_episodes: int
    """Charged episodes; 0 when `cancelled`."""
    mean_return: float | None
    """Over its train episodes; None unless it is ok."""
    std_return: float | None
    """Population standard deviation of the same returns."""
    remaining_budget: int
    """Train episodes left after it."""
    validation: float | None
    """Mean return on the hidden validation cases; None when there is none."""
    selected: bool


class EpisodeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One row per episode, of a submit (`train`) or of the score (`heldout`)."""

    run: str
    env: str
    entry: str
    split: str
    """`train` or `heldout`."""
    submit: int | None
    """Index of the submit; for a held-out episode, of the selected submit."""
    episode: int
    """Index within the submit, or within the held-out episodes, from 0."""
    case: int | None = None
    """Train id; None for held-out episodes, whose cases have no ids."""
    episode_return: float
    """Sum of rewards."""
    length: int | None = None
    """Steps; None for held-out episodes."""
    failed: bool | None = None
    """Whether the policy failed; None for held-out episodes."""


class Run:
    """A finished run."""

    def __init__(self, folder: Path, record: RunRecord, summaries: Sequence[Summary]) -> None:
        self.folder = folder
        self._record = record
        self._summaries = tuple(summaries)

    @property
    def summary(self) -> RunSummary:
        """The run as one row."""
        return self._record.summary(str(self.folder))

    @property
    def score(self) -> float | None:
        """Held-out mean return of the selected checkpoint; None without an ok submit."""
        return self._record.outcome.score

    @property
    def status(self) -> str:
        """`completed`, `no_ok_submit`, `error` or `cancelled`."""
        return self._record.outcome.status

    @property
    def value(self) -> Any:
        """The agent function's return value, decoded from JSON; None for a missing file, such as with other agents.

        An agent can write anything to this file. Raises ConfigError when it is not a regular file, not JSON, or over 1
        MiB.
        """
        path = self.folder / "workspace" / RESULT
        try:
            with open_regular(path) as file:
                data = file.read(_MAX_RESULT_BYTES + 1)
            if len(data) > _MAX_RESULT_BYTES:
                most = f"{_MAX_RESULT_BYTES:,} bytes, the most that an agent function may return"
                raise ConfigError(f"{path} is larger than {most}")
            return msgspec.json.decode(data)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ConfigError(f"{path} is no regular file: {error.strerror}") from error
        except DECODE_ERRORS as error:
            raise ConfigError(f"{path} is no JSON: {error}") from error

    @property
    def submits(self) -> Records[SubmitRecord]:
        """In the order of their indices."""
        outcome = self._record.outcome
        made = partial(
            SubmitRecord, run=str(self.folder), env=self._record.env, entry=self._record.agent.entry
        )
        rows = [
            made(
                submit=one.submit_index,
                status=one.status,
                n_episodes=one.n_episodes,
                mean_return=one.mean_return,
                std_return=one.std_return,
                remaining_budget=one.remaining_budget,
                validation=(outcome.val_scores or {}).get(str(one.submit_index)),
                selected=one.submit_index == outcome.best_submit_index,
            )
            for one in self._summaries
        ]
        return Records(SubmitRecord, rows)

    @property
    def episodes(self) -> Records[EpisodeRecord]:
        """Train episodes of ok submits, then the held-out episodes."""
        record, outcome = self._record, self._record.outcome
        made = partial(EpisodeRecord, run=str(self.folder), env=record.env, entry=record.agent.entry)
        rows = []
        for one in self._summaries:
            cases, lengths, failed = one.env_instances or (), one.episode_lengths or (), set(one.errors or ())
            for index, value in enumerate(one.returns or ()):
                row = made(
                    split="train",
                    submit=one.submit_index,
                    episode=index,
                    case=cases[index] if index < len(cases) else None,
                    episode_return=value,
                    length=lengths[index] if index < len(lengths) else None,
                    failed=index in failed,
                )
                rows.append(row)
        best, returns = outcome.best_submit_index, enumerate(outcome.heldout_returns)
        rows += [
            made(split="heldout", submit=best, episode=index, episode_return=value)
            for index, value in returns
        ]
        return Records(EpisodeRecord, rows)

    @property
    def replays(self) -> list[Path]:
        """Paths of the existing videos of held-out episodes (`replays="first"` or `"all"`)."""
        return [self.folder / one.path for one in self._record.replays if (self.folder / one.path).is_file()]

    def __repr__(self) -> str:
        score = "no score" if self.score is None else f"score {self.score:.4g}"
        return f"<Run of {self._record.agent.entry} on {self._record.env}: {self.status}, {score}>"

    def _repr_html_(self) -> str:
        shown = self.submits
        plot = bars([one.mean_return for one in shown], "mean return of each submit")
        return f"<p>{html.escape(repr(self))}</p>{plot}{shown._table(3)}{self._video()}"

    def _video(self) -> str:
        for path in self.replays[:1]:
            if path.suffix == ".mp4" and path.stat().st_size <= _MAX_SHOWN_VIDEO_BYTES:
                data = base64.b64encode(path.read_bytes()).decode()
                return f'<video controls width="400" src="data:video/mp4;base64,{data}"></video>'
        return ""


class Runs(Sequence[Run]):
    """Finished runs in the order of their folders."""

    def __init__(self, runs: Sequence[Run], left_out: Sequence[tuple[Path, str]]) -> None:
        self._runs = tuple(runs)
        self.left_out = tuple(left_out)
        """Pairs of a folder that could not be read and the reason."""

    def __getitem__(self, index: Any) -> Any:
        return self._runs[index]

    def __len__(self) -> int:
        return len(self._runs)

    def summaries(self) -> Records[RunSummary]:
        """One row per run."""
        return Records(RunSummary, [run.summary for run in self._runs])

    def submits(self) -> Records[SubmitRecord]:
        """One row per submit."""
        return Records(SubmitRecord, [one for run in self._runs for one in run.submits])

    def episodes(self) -> Records[EpisodeRecord]:
        """One row per episode."""
        return Records(EpisodeRecord, [one for run in self._runs for one in run.episodes])

    def __repr__(self) -> str:
        return f"<{len(self)} runs" + (f", {len(self.left_out)} left out>" if self.left_out else ">")

    def _repr_html_(self) -> str:
        return self.summaries()._repr_html_()


def load_runs(*paths: str | os.PathLike[str]) -> Runs:
    """Reads all runs of evopolicy in or below these folders; unreadable ones go to `Runs.left_out`.

    Raises ConfigError without arguments, and when a folder holds no run. Runs of the published software are not read;
    `evopolicy report` reads them.
    """
    if not paths:
        raise ConfigError("load_runs needs a folder, such as runs/")
    folders, without = run_folders(check_argument("folder", path) for path in paths)
    if without:
        raise ConfigError(no_run_below(without[0]))
    runs, left_out = [], []
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except (ProtocolError, OSError) as error:
            left_out.append((folder, str(error)))
    return Runs(runs, left_out)


def read_run(folder: Path) -> Run:
    """Reads the run in `folder`. Raises ProtocolError or OSError when it holds no finished run."""
    return Run(folder, read_record(folder), summaries_of(folder))


def summaries_of(folder: Path) -> list[Summary]:
    """The summaries of a run's submits, in order. Raises ProtocolError for a damaged one."""
    return [one.summary for one in read_submits(folder) if one.summary is not None]
