"""The runs in some folders, finished and open, as far as their files tell, and which of their results are hidden still.

Rule: hidden results of a run are shown only when no agent of a related run is alive. Related are the runs of one
environment whose hidden cases are shared. An agent counts as alive where the cluster says so, or where its supervisor
holds its lock here. A cluster that does not answer might have such agents: then nothing hidden is shown.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import time
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.messages.run_settings import Start
from evopolicy_common.messages.status import RunStatus
from evopolicy_common.records import open_run
from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.records.run_files import RUN_JSON, read_record
from evopolicy_common.records.suite_folder import INDEX, PAUSED, Index, SweepRun
from evopolicy_common.records.summary import Summary
from evopolicy_common.regular_files import MAX_NAMES, Confined, read_regular
from evopolicy_results.reading.environments import learn_names
from evopolicy_results.reading.reader import find_run_dirs
from evopolicy_results.reading.records import PastSubmit

T = TypeVar("T")

_MAX_SUMMARY_BYTES = 8 << 20
_TOKENS = ("input_noncached", "cache_read", "cache_creation", "output")


class RunFacts(msgspec.Struct, frozen=True, kw_only=True):
    """One run: from its folder, from its sweep's index, from the cluster, or from several of them."""

    key: str
    """In URLs; it has no path in it."""
    path: Path | None
    """None for a run without a folder on this host."""
    run: str = ""
    """The cluster's id."""
    entry: str
    env: str
    exp_id: str = ""
    repeat: int = 0
    attempt: int = 1
    state: str
    """`pending`, `open`, `interrupted`, `validation`, `heldout`, `random`, or how it ended."""
    budget: int | None = None
    used: int = 0
    n_submits: int = 0
    best: float | None = None
    """Highest mean train return of an ok submit."""
    tokens: int = 0
    cost: float = 0.0
    error: str = ""
    host: str = ""
    waits_for: str = ""
    retries: int = 0
    """Jobs of a finished run that were repeated after infrastructure failures."""
    running: int = 0
    queued: int = 0
    agent_alive: bool = False
    started_at: float | None = None
    wall_s: float = 0.0
    hidden_cases: str = "shared"
    score: float | None = None
    """Hidden; shown only where `ShownRuns.may_show` permits it."""
    random: float | None = None
    """Uniform random actions on the same hidden cases."""
    finished: bool = False
    stamp: tuple[int, int] = (0, 0)
    """Time and size of a finished run's record."""
    start: Start | None = None
    """The submit from which it starts. `parent_scored` is known of a finished run only."""
    replay_of: str = ""
    """The cluster's id of the run that it plays again."""

    @property
    def origin(self) -> str:
        """The run that it comes from, in words; empty for most runs."""
        if self.replay_of:
            return f"replay of {self.replay_of}"
        return "" if self.start is None else f"from {self.start.text}"

    @property
    def origin_run(self) -> str:
        """The cluster's id of the run that it comes from; empty for most runs."""
        return self.replay_of or ("" if self.start is None else self.start.run)

    @property
    def remaining_s(self) -> float | None:
        """Seconds until the budget is spent, at the present rate."""
        if self.finished or self.started_at is None or not self.budget or not self.used:
            return None
        return max(0.0, (time.time() - self.started_at) * (self.budget - self.used) / self.used)


class ShownSweep(msgspec.Struct, frozen=True, kw_only=True):
    """One folder that was named, or one sweep below it."""

    name: str
    root: Path | None
    runs: tuple[RunFacts, ...]
    paused: bool = False


class ShownRuns(msgspec.Struct, frozen=True, kw_only=True):
    sweeps: tuple[ShownSweep, ...] = ()
    by_key: Mapping[str, RunFacts] = {}
    shut: frozenset[str] | None = frozenset()
    """Environments of which a related agent may be alive; None: of all."""
    origins: frozenset[str] = frozenset()
    """Ids of runs that a run whose agent may be alive plays again or comes from."""

    @property
    def entries(self) -> list[str]:
        """The agents; each has one look on all pages."""
        return sorted({run.entry for run in self.by_key.values()})

    def of(self, name: str) -> RunFacts | None:
        """The run with this id of the cluster; None if it is not here. A replay has an id of its own."""
        return next((run for run in self.by_key.values() if run.run == name), None)

    def may_show(self, run: RunFacts) -> bool:
        """Whether hidden results of a finished run may be shown now."""
        if not run.finished or self.shut is None:
            return False
        if run.hidden_cases == "per_run":
            return run.run not in self.origins
        return run.env not in self.shut


def key_of(text: str) -> str:
    """The name of a run in URLs."""
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:16]


class FolderReader:
    """Reads the folders again and again, and only what has changed."""

    def __init__(self, roots: Sequence[Path]) -> None:
        self.roots = tuple(root.resolve() for root in roots)
        self._records: dict[Path, tuple[tuple[int, int], RunFacts]] = {}
        self._submits: dict[Path, dict[int, Summary]] = {}

    def read_runs(self, cluster: Sequence[RunStatus] | None, *, cluster_is_known: bool) -> ShownRuns:
        """All runs as they are now. `cluster`: its unfinished runs; `cluster_is_known` False: it should be asked and
        does not answer."""
        by_run = {status.run: status for status in cluster or ()}
        by_name = {(status.entry, status.env, status.exp_id): status for status in by_run.values()}
        sweeps: list[ShownSweep] = []
        sweep_folders = _sweep_folders(self.roots)
        for root, index in sweep_folders:
            inner = [other for other, _ in sweep_folders if root in other.parents]
            folders, _ = find_run_dirs([root])
            folders = [folder for folder in folders if not any(each in folder.parents for each in inner)]
            if index is None and not folders and inner:
                continue
            entries = [] if index is None else list(index.runs.values())
            by_folder = {root / each.directory: each for each in entries if each.directory}
            here = set(folders)
            runs = [self.run(folder, by_folder.get(folder), by_run) for folder in folders]
            suite = root.name if index is None else index.suite
            for entry in entries:
                if not entry.directory or root / entry.directory not in here:
                    # Another host of the sweep may have started it and reported its id only to the coordinator.
                    name = (entry.agent, entry.env, f"{suite}-{entry.repeat}")
                    status = by_run.get(entry.run) or by_name.get(name)
                    runs.append(_elsewhere(f"{root}\n{entry.name}", entry, status))
            paused = (root / PAUSED).exists()
            sweeps.append(ShownSweep(name=suite, root=root, runs=tuple(runs), paused=paused))
        seen = {run.run for sweep in sweeps for run in sweep.runs}
        others = [each for each in by_run.values() if each.run not in seen]
        if elsewhere := tuple(_elsewhere(each.run, None, each) for each in others):
            sweeps.append(ShownSweep(name="elsewhere on the cluster", root=None, runs=elsewhere))
        by_key = {run.key: run for sweep in sweeps for run in sweep.runs}
        open_here = [run for run in by_key.values() if run.path and run.agent_alive and not run.finished]
        on_cluster = [status for status in by_run.values() if _may_be_alive(status)]
        alive = {*(run.env for run in open_here), *(status.env for status in on_cluster)}
        origins = {*(run.origin_run for run in open_here), *(status.origin for status in on_cluster)}
        self._forget(by_key.values())
        before = {run.run: run.origin_run for run in by_key.values()}
        while further := {before.get(name, "") for name in origins} - origins:
            origins |= further
        shut = frozenset(alive) if cluster_is_known else None
        return ShownRuns(sweeps=tuple(sweeps), by_key=by_key, shut=shut, origins=frozenset(origins - {""}))

    def run(self, folder: Path, entry: SweepRun | None, by_run: Mapping[str, RunStatus]) -> RunFacts:
        try:
            info = (folder / RUN_JSON).stat()
        except OSError:
            return self._open(folder, entry, by_run)
        stamp = (info.st_mtime_ns, info.st_size)
        known = self._records.get(folder)
        if known is None or known[0] != stamp:
            known = self._records[folder] = stamp, replace(_finished(folder), stamp=stamp)
        return known[1] if entry is None else replace(known[1], repeat=entry.repeat)

    def submits(self, folder: Path) -> list[PastSubmit]:
        """The submits of a run, in order; each summary is read once."""
        known = self._submits.setdefault(folder, {})
        for one in read_submits(folder, names=MAX_NAMES, size=_MAX_SUMMARY_BYTES):
            with contextlib.suppress(ProtocolError):
                if one.index not in known and one.summary is not None:
                    known[one.index] = one.summary.brief
        summaries = sorted(known.values(), key=lambda each: each.submit_index)
        consumed = itertools.accumulate(each.n_episodes for each in summaries)
        return [
            PastSubmit(
                index=one.submit_index,
                status=one.status,
                n_episodes=one.n_episodes,
                consumed_before=until - one.n_episodes,
                consumed=until,
                mean_return=one.mean_return if one.status == "ok" else None,
                n_failed_episodes=len(one.errors or ()),
                started_at=one.submit_started_at,
                summary=one,
            )
            for one, until in zip(summaries, consumed, strict=True)
        ]

    def _open(self, folder: Path, entry: SweepRun | None, by_run: Mapping[str, RunStatus]) -> RunFacts:
        intended = _decoded(folder, open_run.INTENDED, CreateRun)
        run = "" if intended is None else intended.run
        status, submits = by_run.get(run), self.submits(folder)
        alive = _agent_alive(folder) if status is None else _may_be_alive(status)
        facts = replace(_placed(folder, "open" if alive else "interrupted"), run=run, agent_alive=alive)
        if entry is not None:
            facts = _with_entry(facts, entry)
            if entry.state != "pending":
                facts = replace(facts, state="open" if entry.state == "running" else entry.state)
        if intended is not None:
            given = intended.settings
            facts = replace(facts, entry=given.entry, env=given.env, exp_id=given.exp_id, repeat=given.repeat)
            facts = replace(facts, budget=given.budget, hidden_cases=given.hidden_cases)
            facts = replace(facts, start=given.start, replay_of=given.replay_of)
        if submits:
            used, last = submits[-1].consumed, submits[-1].summary
            budget = facts.budget or (last and used + last.remaining_budget)
            facts = replace(facts, budget=budget, used=used, n_submits=len(submits), best=_best(submits))
        if status is not None:
            facts = _with_status(facts, status)
        with contextlib.suppress(OSError):
            facts = replace(facts, started_at=(folder / open_run.INTENDED).stat().st_mtime)
        return facts

    def _forget(self, runs: Iterable[RunFacts]) -> None:
        kept = {run.path for run in runs}
        for known in (self._records, self._submits):
            for path in [path for path in known if path not in kept]:
                del known[path]


def _best(submits: Iterable[PastSubmit]) -> float | None:
    return max((one.mean_return for one in submits if one.mean_return is not None), default=None)


def _placed(folder: Path, state: str) -> RunFacts:
    """The facts that follow from the path of a run's folder."""
    entry, env, exp_id = folder.parts[-3:]
    env, key = env.replace("_", "/", 1), key_of(str(folder))
    return RunFacts(key=key, path=folder, entry=entry, env=env, exp_id=exp_id, state=state)


def _finished(folder: Path) -> RunFacts:
    """From `run.json`; a record that cannot be read is a run with that error."""
    try:
        record = read_record(folder)
    except (OSError, ProtocolError) as error:
        return replace(_placed(folder, "unreadable"), error=str(error), finished=True)
    learn_names([record])
    outcome, dimensions, tokens = record.outcome, record.experiment_dimensions, record.agent.tokens
    retries = outcome.auxiliary.get("infrastructure_retries")
    submits = FolderReader([]).submits(folder)
    return RunFacts(
        key=key_of(str(folder)),
        path=folder,
        run=record.run,
        entry=record.agent.entry or record.model,
        env=record.env,
        exp_id=record.exp_id,
        repeat=record.repeat,
        attempt=record.attempt,
        start=record.start,
        replay_of=record.replay_of,
        hidden_cases=dimensions.hidden_cases,
        state=outcome.status,
        budget=dimensions.episode_budget,
        used=outcome.budget_used,
        n_submits=len(submits),
        best=_best(submits),
        tokens=0 if tokens is None else tokens.total,
        cost=0.0 if tokens is None else tokens.cost or 0.0,
        error=outcome.error or "",
        started_at=_unix(record.timing.start_time),
        wall_s=record.timing.wall_time_seconds,
        retries=retries if isinstance(retries, int) else 0,
        score=outcome.score,
        random=outcome.random_score,
        finished=True,
    )


def _elsewhere(key: str, entry: SweepRun | None, status: RunStatus | None) -> RunFacts:
    """A run without a folder here: it has not started, or another host plays it."""
    facts = RunFacts(key=key_of(key), path=None, entry="", env="", state="")
    if entry is not None:
        finished = entry.state not in ("pending", "running")
        facts = replace(_with_entry(facts, entry), run=entry.run, exp_id=entry.name, wall_s=entry.wall_s)
        facts = replace(facts, state=entry.state, finished=finished, score=entry.score, random=entry.random)
        facts = replace(facts, n_submits=entry.n_submits, used=entry.budget_used)
    elif status is not None:
        name = status.exp_id or status.run
        facts = replace(facts, entry=status.entry, env=status.env, exp_id=name, repeat=status.repeat)
    if status is not None:
        used, since = status.budget - status.remaining_budget, status.created_at or None
        facts = replace(_with_status(facts, status), run=status.run, host=facts.host or status.agent_host)
        facts = replace(facts, used=used, n_submits=status.n_submits, best=status.best_mean, started_at=since)
    return facts


def _with_entry(facts: RunFacts, entry: SweepRun) -> RunFacts:
    """With the facts that a sweep's index has of every run of it."""
    tokens = [each for each in (entry.tokens, entry.earlier) if each]
    return replace(
        facts,
        entry=entry.agent,
        env=entry.env,
        repeat=entry.repeat,
        attempt=entry.attempt,
        tokens=sum(int(each.get(name) or 0) for each in tokens for name in _TOKENS),
        cost=sum((float(each.get("cost") or 0.0) for each in tokens), 0.0),
        error=entry.error or "",
        host=entry.host,
    )


def _with_status(facts: RunFacts, status: RunStatus) -> RunFacts:
    """With the facts that only the cluster has of an unfinished run."""
    facts = replace(facts, state=status.phase, budget=status.budget)
    return replace(facts, waits_for=status.waits_for, running=status.running, queued=status.queued)


def _may_be_alive(status: RunStatus) -> bool:
    return bool(status.agent_host) or status.phase == "open"


def _sweep_folders(roots: Iterable[Path]) -> list[tuple[Path, Index | None]]:
    """The sweeps at and directly below the roots, with their indexes. A root that is no sweep has the index None:
    single runs may lie in it."""
    sweeps: dict[Path, Index | None] = {}
    for root in roots:
        if (root / INDEX).exists():
            sweeps[root] = _index(root)
            continue
        with contextlib.suppress(OSError):
            for child in sorted(root.iterdir()):
                if (child / INDEX).exists():
                    sweeps[child] = _index(child)
        sweeps[root] = None
    return list(sweeps.items())


def _index(root: Path) -> Index | None:
    try:
        return msgspec.json.decode(read_regular(root / INDEX), type=Index)
    except (OSError, *DECODE_ERRORS):
        return None


def _decoded(folder: Path, name: str, kind: type[T]) -> T | None:
    """The content of a file of an open run; None where it is missing or damaged."""
    with contextlib.suppress(*DECODE_ERRORS):
        return msgspec.json.decode(Confined(folder).read_file(name, _MAX_SUMMARY_BYTES), type=kind)
    return None


def _agent_alive(folder: Path) -> bool:
    """Whether an agent of an open run may be alive: a lock of its folder is held, or no process here watches it."""
    if (folder / open_run.LISTENER).exists():
        return True
    with contextlib.suppress(OSError):
        state = (folder / open_run.STATE).iterdir()
        return any(open_run.is_held(path) for path in state if path.suffix == ".lock")
    return False


def _unix(text: str) -> float | None:
    with contextlib.suppress(ValueError):
        return datetime.fromisoformat(text).timestamp()
    return None
