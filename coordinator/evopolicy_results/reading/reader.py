"""Reads run directories as typed runs. A damaged or unfinished run is listed with its reason; it never causes a
crash.

A run is complete when its `run.json` is readable and has status `completed` or `no_ok_submit`. All other data come
from the files that the agent saw (`summary.json`) and from the immutable checkpoints; only `run.json` has the hidden
scores. Policies are parsed, never run. Runs of the published software are read too (`published`). A re-score
(`rescore/NAME.json`) replaces the held-out results, and never the selection.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec.structs import replace

from evopolicy_common.errors import BundleError, ConfigError, ProtocolError
from evopolicy_common.messages.bounds import check_plausible
from evopolicy_common.messages.environment import Split
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.policies.checkpoints import CheckpointMeta, bundle_of
from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.records.rescores import Rescored, RescoreRecord, read_rescore
from evopolicy_common.records.run_files import RUN_JSON, check_places, run_folders
from evopolicy_common.records.run_record import (
    ReferenceScore,
    RunRecord,
    decode_run_record,
)
from evopolicy_common.records.splits import SPLITS
from evopolicy_common.records.summary import Summary
from evopolicy_common.regular_files import read_regular
from evopolicy_results.code.sources import n_changed, reachable_modules, read_python_files, source_digest
from evopolicy_results.code.topology import describe
from evopolicy_results.reading import published
from evopolicy_results.reading.parallel import ALONE, Processes
from evopolicy_results.reading.published import PUBLISHED
from evopolicy_results.reading.records import LeftOut, PastRun, PastSubmit, PolicySource

Files = Mapping[str, bytes]

_MAX_REASON_CHARS = 1000


class Loaded(msgspec.Struct, frozen=True, kw_only=True):
    """The results of `load_runs`, both in order of path."""

    runs: tuple[PastRun, ...]
    left_out: tuple[LeftOut, ...]


class UnreadableRunError(Exception):
    """A folder is not a complete run; the message is the reason shown."""


def find_run_dirs(paths: Iterable[Path]) -> tuple[list[Path], list[LeftOut]]:
    """As `run_folders`; paths without a run directory are returned with the reason."""
    folders, without = run_folders(paths)
    left_out = []
    for path in without:
        if path.is_dir():
            reason = "no run directory here"
        else:
            reason = "a file, not a run directory" if path.exists() else "no such folder"
        left_out.append(LeftOut(path=path, reason=reason))
    return folders, left_out


def load_runs(
    paths: Iterable[Path], *, processes: Processes = ALONE, progress: Callable[[int, int], None] | None = None
) -> Loaded:
    """Reads all complete runs at or under `paths`, and lists the others with the reason, duplicates of an earlier run
    too. `processes` read in parallel; `progress` is called with (done, total)."""
    folders, left_out = find_run_dirs(paths)
    read = processes.map(read_or_explain, folders, lambda folder, why: LeftOut(path=folder, reason=why))
    seen: dict[tuple[bool, str, str, str, int], PastRun] = {}
    for done, run in enumerate(read, start=1):
        if progress is not None:
            progress(done, len(folders))
        if isinstance(run, LeftOut):
            left_out.append(run)
            continue
        key = (run.is_published, run.entry, run.env, run.record.exp_id, run.record.repeat)
        if of := run.record.replay_of:
            left_out.append(LeftOut(path=run.path, reason=f"a replay of run {of}, and no run of its own"))
        elif (first := seen.setdefault(key, run)) is not run:
            left_out.append(LeftOut(path=run.path, reason=f"repeats the run in {first.path}"))
    return Loaded(runs=reconciled(list(seen.values())), left_out=tuple(left_out))


def reconciled(runs: Sequence[PastRun]) -> tuple[PastRun, ...]:
    """The runs, where a published run has the splits of our runs on its files, and an entry of its own if one of ours
    has its name.

    The published software records the hash of a case file's bytes, and we also that of the cases which a run used. A
    run of ours on the same file therefore tells which cases a published run used.
    """
    entries = {run.entry for run in runs if not run.is_published}
    used: dict[tuple[Split, str], dict[str, set[int]]] = {}
    for run, split in itertools.product(runs, SPLITS):
        if not run.is_published:
            versions, n = run.record.versions, run.record.experiment_dimensions.n_cases(split)
            by_cases = used.setdefault((split, versions.file_hash(split)), {})
            by_cases.setdefault(versions.cases_hash(split), set()).add(n)

    def reconcile(run: PastRun) -> PastRun:
        agent, versions = run.record.agent, run.record.versions
        hashes = dict(versions.cases_hashes)
        for split in SPLITS:
            n = run.record.experiment_dimensions.n_cases(split)  # 0 if unknown
            # Several runs of ours may have used different numbers of cases of the file.
            by_cases = used.get((split, versions.file_hash(split)), {})
            fitting = [cases for cases, counts in by_cases.items() if not n or n in counts]
            if len(fitting) == 1:
                hashes[split] = fitting[0]
        if run.entry in entries:
            agent = replace(agent, entry=f"{run.entry} ({published.HARNESS})")
        versions = replace(versions, cases_hashes=hashes)
        return replace(run, record=replace(run.record, agent=agent, versions=versions))

    return tuple(reconcile(run) if run.is_published else run for run in runs)


def read_or_explain(folder: Path) -> PastRun | LeftOut:
    """The run in `folder`, or the reason why it is left out."""
    try:
        return read_run(folder)
    except Exception as error:  # the other runs are read regardless of an agent's leftovers
        kind = "" if isinstance(error, UnreadableRunError) else f"{type(error).__name__}: "
        return LeftOut(path=folder, reason=f"{kind}{error}"[:_MAX_REASON_CHARS])


def read_run(folder: Path) -> PastRun:
    """Reads the complete run in `folder`. Raises UnreadableRunError with the reason when there is none."""
    record = _read_record(folder)
    outcome = record.outcome
    if outcome.status == "error":
        raise UnreadableRunError(f"the run ended in an error: {outcome.error or 'no reason given'}")
    if outcome.status == "cancelled":
        raise UnreadableRunError(f"the run was {outcome.error or 'cancelled'}")
    if outcome.agent_never_played:
        raise UnreadableRunError(
            "its agent failed before it used any budget; the run says nothing about the agent"
        )
    if outcome.status == "completed":
        if outcome.final_score is None or not math.isfinite(outcome.final_score):
            raise UnreadableRunError("run.json says completed, and has no final_score")
        if outcome.best_submit_index is None:
            raise UnreadableRunError("run.json says completed, and has no best_submit_index")
    run = PastRun(path=folder, record=record, submits=_read_submits(folder, record))
    if outcome.status == "completed" and run.selected is None:
        raise UnreadableRunError(f"the selected submit {outcome.best_submit_index} has no files")
    try:
        check_plausible({"run.json": run.record, "submits": run.submits})
    except ValueError as error:
        raise UnreadableRunError(str(error)) from error
    return run


def _read_record(folder: Path) -> RunRecord:
    try:
        with _reasons(f"{RUN_JSON}: "):
            data = read_regular(folder / RUN_JSON)
            record = published.read_record(folder, data) or decode_run_record(data)
            check_places(folder, record.artifacts)
    except FileNotFoundError as error:
        raise UnreadableRunError("unfinished: run.json is missing") from error
    except OSError as error:
        raise UnreadableRunError(f"run.json: {error.strerror}") from error
    return record


def _read_submits(folder: Path, record: RunRecord) -> tuple[PastSubmit, ...]:
    budget = record.experiment_dimensions.episode_budget
    submits: list[PastSubmit] = []
    previous: Files | None = None
    consumed = 0
    for one in read_submits(folder, record.artifacts):
        index, checkpoint = one.index, one.checkpoint
        for place in (checkpoint, one.feedback):
            if place.is_symlink():
                name = place.relative_to(folder)
                raise UnreadableRunError(f"{name} is a link; put the folder itself in its place")
        with _reasons():
            is_ours = record.record_version != PUBLISHED
            summary = one.summary if is_ours else published.read_summary(one.feedback / "summary.json")
            meta = one.meta
        if summary is not None:
            status: str = summary.status
            n_episodes, mean, remaining = summary.n_episodes, summary.mean_return, summary.remaining_budget
        elif meta is not None:
            status, n_episodes, mean = meta.validation_status, meta.n_episodes_requested, meta.mean_return
            remaining = meta.remaining_budget_after
        else:
            raise UnreadableRunError(f"submit {index} has neither summary.json nor _meta.json")
        after = budget - consumed - n_episodes if remaining is None else remaining
        # The published software gives a folder to some requests that it refuses.
        if status in ("budget_invalid", "invalid_env_instance"):
            continue
        before, consumed = consumed, budget - after
        files, source = None, None
        if status == "ok" and checkpoint.is_dir():
            files, source = describe_files(read_python_files(checkpoint))
        changed = None if files is None or previous is None else count_changed_lines(previous, files)
        previous = previous if files is None else files
        submits.append(
            PastSubmit(
                index=index,
                status=status,
                n_episodes=n_episodes,
                consumed_before=before,
                consumed=consumed,
                mean_return=mean,
                val_mean=(record.outcome.val_scores or {}).get(str(index)),
                n_failed_episodes=len(summary.errors or ()) if summary is not None else 0,
                started_at=summary.submit_started_at if summary is not None else "",
                bundle_digest=_bundle_digest(meta, checkpoint) if status == "ok" else "",
                source=source,
                changed_lines=changed,
                summary=summary.brief if isinstance(summary, Summary) else None,
            )
        )
    return tuple(submits)


def _bundle_digest(meta: CheckpointMeta | None, checkpoint: Path) -> str:
    """As recorded, or of the checkpoint's files if other software wrote its metadata; empty if there are none."""
    try:
        return "" if meta is None else meta.bundle or bundle_of(checkpoint).digest
    except (BundleError, OSError):
        return ""


@contextmanager
def _reasons(name: str = "") -> Iterator[None]:
    """A damaged file's error is the reason for leaving out its run."""
    try:
        yield
    except ProtocolError as error:
        raise UnreadableRunError(f"{name}{error}") from error


_described: dict[str, PolicySource] = {}
_MAX_DESCRIBED = 4096


def describe_files(files: Files) -> tuple[Files, PolicySource | None]:
    """The reachable source files among a bundle's Python files, and their description; None without a `policy.py`.
    Descriptions of recent bundles are kept, as runs share policies."""
    modules = reachable_modules(files)
    reached = {module.path: module.source for module in modules.values()}
    if not modules:
        return reached, None
    digest = source_digest(modules)
    known = _described.get(digest)
    if known is None:
        topology, features = describe(modules)
        known = _described[digest] = PolicySource(
            digest=digest, topology=topology, features=features, files=tuple(sorted(reached))
        )
        if len(_described) > _MAX_DESCRIBED:
            del _described[next(iter(_described))]
    return reached, known


def count_changed_lines(before: Files, after: Files) -> int:
    """Lines removed plus lines added between two source bundles, file by file; a renamed file counts twice."""
    pairs = [(before.get(path, b""), after.get(path, b"")) for path in {*before, *after}]
    return sum(n_changed(old.splitlines(), new.splitlines()) for old, new in pairs if old != new)


_SHOWN = 4
_HELDOUT: Split = "heldout"


def rescored(runs: Sequence[PastRun], name: str) -> list[PastRun]:
    """The runs with the held-out results of their re-score `name`; runs without a selected checkpoint stay as they are.
    Raises ConfigError when a run has no such re-score, or one of another run."""
    missing, out = [], []
    for run in runs:
        best = run.record.outcome.best_submit_index
        if run.score is None or best is None:
            out.append(run)
            continue
        try:
            record = read_rescore(run.path, name)
        except ProtocolError as error:
            raise ConfigError(str(error)) from error
        if record is None:
            missing.append(str(run.path))
        elif (record.run, record.env, record.selected) != (run.record.run, run.env, best):
            raise ConfigError(
                f"{run.path}: its re-score {name} is one of another run; remove it and re-score the run"
            )
        elif (played := record.checkpoint(best)) is None or not record.random_returns:
            raise ConfigError(f"{run.path}: its re-score {name} is incomplete; repeat `evopolicy rescore`")
        else:
            out.append(_replaced(run, record, played))
    if missing:
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise ConfigError(
            f"no re-score {name} of {', '.join(missing[:_SHOWN])}{more}: play it with `evopolicy rescore RUN… --name"
            f" {name}`, or leave these runs out"
        )
    return out


def _replaced(run: PastRun, record: RescoreRecord, played: Rescored) -> PastRun:
    outcome, versions, random = run.record.outcome, run.record.versions, record.random_returns
    replaced = replace(
        run.record,
        outcome=replace(
            outcome,
            final_score=played.mean,
            heldout_mean_return=played.mean,
            heldout_std_return=std(played.returns),
            heldout_returns=tuple(played.returns),
            # As in a run's own result: a rate over the episodes that report it would leave failed ones out.
            heldout_successes=() if None in played.successes else tuple(map(bool, played.successes)),
            random_reference=ReferenceScore(
                mean_return=mean(random), std_return=std(random), returns=tuple(random)
            ),
        ),
        experiment_dimensions=replace(run.record.experiment_dimensions, n_heldout=record.n_cases),
        versions=replace(
            versions,
            cases_hashes={**versions.cases_hashes, _HELDOUT: record.cases_hash},
            data_secret=versions.data_secret and record.cases_secret,
        ),
    )
    return replace(run, record=replaced, rescore=record)
