"""Plays finished runs' checkpoints on further hidden cases and writes `rescore/NAME.json`.

Rules that this module owns:
- The cases are disjoint from the run's three splits. The coordinator checks this and takes everything else (policy,
  seeds, limits, scope, definition) from its own record of the run.
- All runs of an environment get the same cases under the same name. An existing file with other cases is refused.
- Only workers of the run's own versions play. A re-score never changes `run.json`.
- The coordinator keeps outcomes under keys that follow from run, checkpoint and cases. An interrupted command therefore
  continues where it stopped.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import msgspec

from evopolicy_common.errors import BundleError, ConfigError, ProtocolError, RefusedError
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import RANDOM, EpisodeOutcome
from evopolicy_common.messages.operator import DescribeEnvironment, Rescore
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.rescores import (
    Rescored,
    RescoreRecord,
    encode_rescore,
    read_rescore,
    rescore_path,
)
from evopolicy_common.records.run_files import read_or_reason
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.splits import FILE_STEMS, cases_hash, folder_of, read_split_file
from evopolicy_common.records.words import in_words
from evopolicy_common.refusals import WRONG_SETTINGS, Refusal
from evopolicy_results.evaluations import Evaluations, unlike
from evopolicy_results.reading.comparability import comparable
from evopolicy_results.reading.records import checkpoint_folder

_FROM_OPTIONS = WRONG_SETTINGS | {Refusal.UNKNOWN_RUN, Refusal.UNKNOWN_SUBMIT, Refusal.MISSING_BUNDLE}
"""Refusals that an option of the command causes."""


class Wanted(msgspec.Struct, frozen=True, kw_only=True):
    """Which episodes a re-score has."""

    name: str
    n_cases: int | None
    """Number of cases to derive; None: all of `data`."""
    data: Path | None
    """Folder of split files whose held-out cases are played."""
    every: bool
    """All eligible checkpoints instead of the selected one."""


class RunToRescore(msgspec.Struct, frozen=True, kw_only=True):
    """A finished run with a selected checkpoint."""

    folder: Path
    record: RunRecord
    selected: int

    def submits(self, wanted: Wanted) -> list[int]:
        """The checkpoints to play, the selected one first."""
        others = sorted(int(index) for index in self.record.outcome.val_scores or {} if index.isdecimal())
        return [self.selected, *(index for index in others if wanted.every and index != self.selected)]


class Written(msgspec.Struct, frozen=True, kw_only=True):
    """One run's re-score."""

    run: str
    path: str
    env: str
    entry: str
    score: float
    """Held-out mean of `run.json`."""
    rescored: float
    """Mean on the further cases."""
    episodes: int
    """Played by this command or an interrupted one before it; 0 when the file was complete."""


def read_finished(folders: Sequence[Path]) -> tuple[list[RunToRescore], list[str], list[str]]:
    """The runs in these directories, those without anything to re-score, and damaged or unfinished ones; with
    reasons."""
    finished, without, unreadable = [], [], []
    for folder in folders:
        record = read_or_reason(folder)
        if isinstance(record, str):
            unreadable.append(f"{folder}: {record}")
        elif record.outcome.status != "completed" or record.outcome.best_submit_index is None:
            without.append(f"{folder}: {in_words(record.outcome.status)}, without a selected checkpoint")
        else:
            selected = record.outcome.best_submit_index
            finished.append(RunToRescore(folder=folder, record=record, selected=selected))
    return finished, without, unreadable


async def rescore(run: RunToRescore, wanted: Wanted, evaluations: Evaluations) -> Written:
    """Plays the missing episodes of one run and writes its file. Raises ConfigError for runs, cases or versions
    that do not fit."""
    try:
        return await _rescore(run, wanted, evaluations)
    except RefusedError as error:
        if error.status in _FROM_OPTIONS:
            raise ConfigError(error.message) from error
        raise


async def _rescore(run: RunToRescore, wanted: Wanted, evaluations: Evaluations) -> Written:
    record, path = run.record, rescore_path(run.folder, wanted.name)
    fingerprint_class = await class_of(record, evaluations)
    cases, secret, epoch = await _cases(record, wanted, evaluations)
    digest = f"sha256:{cases_hash(cases)}"
    try:
        known = read_rescore(run.folder, wanted.name)
    except ProtocolError as error:
        raise ConfigError(f"{error}; remove the file to play it again") from error
    if known is not None and (known.cases_hash, known.run) != (digest, record.run):
        raise ConfigError(f"{path} holds {known.n_cases} other cases, or another run; choose another --name")
    began = evaluations.played
    result = known or RescoreRecord(
        name=wanted.name,
        run=record.run,
        env=record.env,
        selected=run.selected,
        n_cases=len(cases),
        cases_hash=digest,
        cases_from="secret" if wanted.data is None else "files",
        cases_secret=secret,
        epoch=epoch,
        software=version("evopolicy"),
    )
    missing = [index for index in run.submits(wanted) if result.checkpoint(index) is None]
    if missing and not result.random_returns:
        missing.insert(0, RANDOM)
    for index in missing:
        # Garbage collection may have removed the policy from the coordinator, which otherwise refuses.
        with contextlib.suppress(BundleError):
            if index != RANDOM:
                bundle = bundle_of(checkpoint_folder(run.folder, "checkpoints", index))
                await evaluations.ask.upload(bundle.digest, bundle.packed)
        played = await _play(record, index, cases, fingerprint_class, evaluations)
        if index == RANDOM:
            result = msgspec.structs.replace(result, random_returns=played.returns)
            continue
        result = msgspec.structs.replace(
            result,
            played_at=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            checkpoints=tuple(sorted((*result.checkpoints, played), key=lambda each: each.submit_index)),
        )
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, encode_rescore(result))
    selected, score = result.checkpoint(run.selected), record.outcome.score
    assert selected is not None
    assert score is not None
    return Written(
        run=record.run,
        path=str(path),
        env=record.env,
        entry=record.agent.entry,
        score=score,
        rescored=selected.mean,
        episodes=evaluations.played - began,
    )


async def class_of(record: RunRecord, evaluations: Evaluations) -> str:
    """The fingerprint class of workers with the run's versions. Raises ConfigError when there are none."""
    message = DescribeEnvironment(env=record.env, run=record.run)
    state = await evaluations.versions(message)
    if not state.knows_run:
        raise ConfigError(
            f"this cluster's coordinator has no finished run {record.run}: it is still open there, or another one"
            " played it; use that one (--connect, or --local with its --state)"
        )
    if not state.fingerprints:
        remedy = f"start one with --env {record.env}"
        if evaluations.ask.own:
            remedy = f"`evopolicy-worker check-env {record.env}` shows why"
        raise ConfigError(f"no worker of this cluster offers {record.env}; {remedy}")
    differences: list[str] = []
    for number, fingerprint in enumerate(state.fingerprints):
        versions = comparable([record.versions.fingerprint, fingerprint.flat()])
        for each in versions:
            each.pop("cpu", None)
        differing = unlike(*versions)
        if not differing or not record.versions.fingerprint:
            return state.classes[number] if state.classes else ""
        differences = differences or differing
    raise ConfigError(
        f"no worker has the versions that run {record.run} was played with ({'; '.join(differences[:4])}): other"
        " versions give other scores; start a worker with the run's versions"
    )


async def _cases(
    record: RunRecord, wanted: Wanted, evaluations: Evaluations
) -> tuple[tuple[Case, ...], bool, str]:
    """The cases, whether they are secret, and the epoch of their secret."""
    if wanted.data is None:
        assert wanted.n_cases is not None
        further = await evaluations.ask.further_cases(record.run, wanted.name, wanted.n_cases)
        return further.cases, True, further.epoch
    path = folder_of(wanted.data, record.env) / f"{FILE_STEMS['heldout']}.json"
    content, _ = read_split_file(path)
    if content.env != record.env:
        raise ConfigError(f"{path} holds cases of {content.env!r}, not of {record.env!r}")
    n = len(content.cases) if wanted.n_cases is None else wanted.n_cases
    if not 1 <= n <= len(content.cases):
        raise ConfigError(f"{path} has {len(content.cases)} cases, {n} are asked for")
    return content.cases[:n], content.secret is True, ""


async def _play(
    record: RunRecord, index: int, cases: tuple[Case, ...], fingerprint_class: str, evaluations: Evaluations
) -> Rescored:
    """Plays all cases, in as many attempts as it takes; earlier attempts' outcomes are read, not played again."""
    is_whole = record.experiment_dimensions.policy_scope == "submit" and index != RANDOM
    outcomes: dict[int, EpisodeOutcome] = {}
    for attempt in itertools.count():
        if len(outcomes) == len(cases):
            break
        if is_whole:
            outcomes.clear()
        missing = tuple(place for place in range(len(cases)) if place not in outcomes)
        text = f"rescore {record.run} {index} sha256:{cases_hash(cases)} {attempt}"
        message = Rescore(
            key=hashlib.sha256(text.encode()).hexdigest(),
            run=record.run,
            submit_index=index,
            cases=cases,
            indexes=missing,
            fingerprint_class=fingerprint_class,
        )
        async for outcome in evaluations.outcomes(message):
            outcomes[missing[outcome.index]] = outcome
    played = [outcomes[place] for place in range(len(cases))]
    solved = tuple(one.success for one in played)
    return Rescored(
        submit_index=index,
        returns=tuple(one.episode_return for one in played),
        lengths=tuple(one.length for one in played),
        failures={str(n): one.failure.category for n, one in enumerate(played) if one.failure is not None},
        successes=solved if any(each is not None for each in solved) else (),
    )
