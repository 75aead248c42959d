"""Builds the events of requests that open runs and evaluations: from the store, the cases and fresh secrets.

Rules that this module owns:
- Cases, secrets and the lineage of a run come from this coordinator, never from the request.
- A run's name and secrets follow from its key and the coordinator's own: a run that is lost with the work since a
  backup is opened again as the same run.
- A replay has the cases and the secret of its run, and the run's key proves the right to it.
- Everything here reads files: call it on a thread. A request that is refused here has changed nothing.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import secrets
from collections.abc import Iterator
from pathlib import Path

from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_common.catalogue.worlds import OPTION, unchanged
from evopolicy_common.errors import ConfigError, RefusedError
from evopolicy_common.messages import operator
from evopolicy_common.messages.environment import Case, Split, StepLimit
from evopolicy_common.messages.episode import RANDOM
from evopolicy_common.messages.run_settings import (
    MAX_EPISODES_PER_SUBMIT,
    PUBLISHED_TRAIN,
    Line,
    RunSettings,
    episode_counts,
    metering_of,
    off_profile,
)
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.journal import SALT_BYTES
from evopolicy_common.records.splits import SPLITS, overlaps
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.contract.events import (
    AnyEvent,
    DisclosureRequested,
    EvaluationRequested,
    RunRequested,
)
from evopolicy_coordinator.core.contract.reasons import because
from evopolicy_coordinator.core.contract.records import EvaluationRow, RunRow
from evopolicy_coordinator.pki.identity import of_run
from evopolicy_coordinator.server.reader import ServiceReader
from evopolicy_coordinator.server.reason_texts import reason_text
from evopolicy_coordinator.server.request_checks import (
    MAX_COUNT,
    check_bundle,
    check_idempotency_key,
    check_job,
    check_limits,
    check_stored,
    require,
)
from evopolicy_coordinator.splits import EnvironmentSplits, SplitSource

_Opens = operator.CreateRun | operator.Disclose | operator.Evaluate | operator.Rescore


@contextlib.contextmanager
def _wrong_settings_refused() -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise RefusedError(Refusal.INVALID_SETTINGS, str(error)) from error


class RunRequests:
    """Every method raises RefusedError for a request that cannot be served."""

    def __init__(
        self,
        reader: ServiceReader,
        blobs: BlobStore,
        source: SplitSource,
        *,
        allowed_imports: tuple[str, ...],
        denied_imports: tuple[str, ...],
    ) -> None:
        self.allowed_imports = allowed_imports
        self._denied_imports = denied_imports
        self._reader = reader
        self._blobs = blobs
        self._source = source

    @_wrong_settings_refused()
    def event(self, message: _Opens, request: int, stimulus: str) -> AnyEvent:
        """Returns the event of a request that creates something."""
        if isinstance(message, operator.Disclose):
            epochs = self._reader.epochs(message.runs)
            return DisclosureRequested(message=message, request=request, stimulus_id=stimulus, epochs=epochs)
        check_idempotency_key(message.key)
        if isinstance(message, operator.CreateRun):
            # A run of another coordinator is played again as any run, with this one's cases and a new secret.
            of = self._reader.replayed(message.settings.replay_of)
            row = self._run(message) if of is None else self._replay(message, of)
            require(message.run in ("", row.run), Refusal.UNKNOWN_RUN, f"unknown run {message.run[:64]!r}")
            return RunRequested(message=message, request=request, stimulus_id=stimulus, row=row)
        if isinstance(message, operator.Rescore):
            listed = self.rescore(message, *self._reader.finished_with_result(message.run))
        else:
            listed = self._evaluation(message)
        return EvaluationRequested(message=message, request=request, stimulus_id=stimulus, row=listed)

    def _run(self, m: operator.CreateRun) -> RunRow:
        wanted = m.settings
        check_limits(wanted.limits)
        suite = catalogue.suite_of(wanted.env)
        budget, least, most = episode_counts(wanted, suite)
        published = wanted.profile != "own"
        if published and (differences := off_profile(wanted)):
            raise ConfigError(f"profile {wanted.profile} excludes {differences}")
        if published and not self._source.from_files:
            raise ConfigError(
                f"profile {wanted.profile} plays the published case files, and this coordinator derives its cases"
                " from a secret: start it with --data FOLDER, the folder data/main-128 of the published software"
            )
        related: tuple[Case, ...] = ()
        if wanted.start is not None:
            wanted, related = _started(self._reader, wanted)
        own = m.key if wanted.hidden_cases == "per_run" else ""
        cases = self._splits(wanted.env, wanted.n_validation, wanted.n_heldout, own)
        if published and len(cases.train) != PUBLISHED_TRAIN:
            raise ConfigError(
                f"the published train splits have {PUBLISHED_TRAIN:,} cases each, the one in this coordinator's"
                f" --data has {len(cases.train):,}; give it data/main-128 of the published software, or leave out the"
                " profile"
            )
        hidden = (*cases.validation, *cases.heldout)
        if wanted.policy_scope == "submit":
            largest = most
            if wanted.hidden_evaluation == "pool":
                largest = max(most, len(cases.validation), len(cases.heldout))
            check_job((*cases.train, *hidden), largest)
        secret = run_secret(self._reader.state, m.key)
        run, capability, salt = self._own(m.key, cases.epoch)
        return RunRow(
            run=run,
            key=m.key,
            capability=capability,
            secret=secret,
            salt=salt,
            policy_seeds=hashlib.sha256(secret).hexdigest(),
            settings=wanted,
            budget=budget,
            min_episodes_per_submit=least,
            max_episodes_per_submit=most,
            train=cases.train,
            validation=cases.validation,
            heldout=cases.heldout,
            split_hashes=cases.hashes(),
            cases_secret=cases.secret,
            epoch=cases.epoch,
            trials=cases.trials,
            allowed_imports=self.allowed_imports,
            denied_imports=self._denied_imports,
            max_steps=_max_steps(wanted.env, wanted.step_limit),
            related=tuple(case for case in related if case not in hidden),
        )

    def _replay(self, m: operator.CreateRun, of: RunRow) -> RunRow:
        """The row of a replay of the finished run `of`, with its cases and its secret."""
        if not hmac.compare_digest(m.replay_key.encode(), of.key.encode()):
            raise RefusedError(
                Refusal.BAD_REQUEST,
                f"run {of.run} is another operator's, or its .replay.json is lost or changed: only the operator"
                " that opened a run replays it with its cases",
            )
        wanted, known = m.settings, of.settings
        if wanted.start is not None and known.start is not None:
            start = replace(wanted.start, parent_scored=known.start.parent_scored, line=known.start.line)
            wanted = replace(wanted, start=start)
        same = replace(known, replay_of=of.run, notes=wanted.notes)
        names = [each for each in wanted.__struct_fields__ if getattr(wanted, each) != getattr(same, each)]
        if names:
            raise ConfigError(f"a replay of run {of.run} has other settings than the run: {', '.join(names)}")
        run, capability, salt = self._own(m.key, of.epoch)
        return replace(of, run=run, key=m.key, capability=capability, salt=salt, settings=wanted)

    def _own(self, key: str, epoch: str) -> tuple[str, str, bytes]:
        """Name, token and salt: every run has its own, a replay too. With other cases it is another run."""
        state = self._reader.state
        capability = base64.urlsafe_b64encode(of_run(state, "capability", key)).decode().rstrip("=")
        run = f"r-{of_run(state, f'name|{epoch}', key)[:8].hex()}"
        return run, capability, of_run(state, "salt", key)[:SALT_BYTES]

    def _evaluation(self, m: operator.Evaluate) -> EvaluationRow:
        # The finished run whose episodes are replayed supplies the policy seeds, and the cases if they came from
        # a secret.
        of = None if m.as_in is None else self._reader.finished_run(m.as_in.run)
        check_bundle(self._blobs, m.bundle)
        check_limits(m.limits)
        run = of if _has_derived_cases(of) else None
        cases = (run or self._splits(m.env, None, None)).cases(m.split)
        ids = tuple(range(len(cases))) if m.cases is None else m.cases
        if len(ids) > MAX_EPISODES_PER_SUBMIT:
            raise ConfigError(f"{len(ids):,} cases; {MAX_EPISODES_PER_SUBMIT:,} is the maximum at once")
        self._check_again(m, len(ids))
        wrong = next((case_id for case_id in ids if not 0 <= case_id < len(cases)), None)
        if wrong is not None or not ids:
            text = f"case {wrong} of {m.env}: the cases are 0 to {len(cases) - 1}"
            raise RefusedError(Refusal.INVALID_ENV_INSTANCE, text if ids else "no cases were given")
        return EvaluationRow(
            evaluation=f"e-{secrets.token_hex(8)}",
            key=m.key,
            env=m.env,
            bundle=m.bundle,
            split=m.split,
            record=m.record,
            limits=m.limits,
            replays=m.replays,
            as_in=m.as_in,
            definition=m.definition,
            case_ids=ids,
            cases=tuple(cases[case_id] for case_id in ids),
            secret=secrets.token_bytes(32) if of is None else of.secret,
            tier=m.sandbox_tier,
            max_steps=_max_steps(m.env, m.step_limit),
        )

    def _check_again(self, m: operator.Evaluate, n: int) -> None:
        """Checks that a request to replay episodes is consistent, and that its recordings are stored."""
        text = f"{len(m.replays)} recordings for {n} cases; each case needs one, and no bundle may come with them"
        require(not m.replays or (m.bundle is None and len(m.replays) == n), Refusal.BAD_MESSAGE, text)
        for ref in m.replays:
            check_stored(self._blobs, ref)
        place = m.as_in
        if place is None:
            return
        whole = len(place.env_instances)
        fits = len(place.indexes) == n and all(0 <= index < whole for index in place.indexes)
        fits = fits and 1 <= place.modulo <= MAX_COUNT and -1 <= place.submit_index <= MAX_COUNT
        require(fits, Refusal.BAD_MESSAGE, f"{n} cases and {whole} in their list do not match")
        all_at_once = place.conditions.policy_scope == "submit" and m.bundle is not None
        text = "with policy scope submit only whole submits are played again"
        require(not all_at_once or place.indexes == tuple(range(whole)), Refusal.BAD_MESSAGE, text)

    def rescore(self, m: operator.Rescore, of: RunRow, result: operator.RunFinished) -> EvaluationRow:
        """The row of a re-score: everything but the cases is as in the finished run `of`."""
        settings, n = of.settings, len(m.cases)
        fits = bool(m.indexes) and n <= MAX_EPISODES_PER_SUBMIT and set(m.indexes) <= set(range(n))
        text = f"a re-score names positions in its list of cases; here are {n:,} cases"
        require(fits, Refusal.BAD_REQUEST, text)
        if repeated := overlaps(
            {"train": of.train, "validation": of.validation, "heldout": (*of.heldout, *m.cases)}
        ):
            raise ConfigError(f"the new cases are not disjoint from those of run {of.run}: {repeated[0]}")
        worlds = {(case.options or {}).get(OPTION) for case in (*of.train, *m.cases)}
        if unchanged(settings.env) != settings.env and len(worlds) > 1:
            raise ConfigError(
                f"the new cases are of another world than run {of.run}: give each the run's key in options.{OPTION}"
            )
        submit = next((each for each in result.submits if each.submit_index == m.submit_index), None)
        is_random = m.submit_index == RANDOM
        if not is_random and (submit is None or submit.status != "ok" or submit.bundle is None):
            raise RefusedError(Refusal.UNKNOWN_SUBMIT, f"run {of.run} has no ok submit {m.submit_index}")
        bundle = None if submit is None else submit.bundle
        check_bundle(self._blobs, bundle)
        ids, how = tuple(len(of.heldout) + index for index in range(n)), settings.conditions
        if is_random:
            how = replace(how, policy_scope="episode", observations="arrays")
        place = operator.PlayedAs(
            run=of.run,
            submit_index=m.submit_index,
            env_instances=ids,
            indexes=m.indexes,
            modulo=n if submit is None else len(submit.env_instances),
            remaining_budget_after=0 if submit is None else submit.remaining_budget,
            conditions=how,
        )
        if how.policy_scope == "submit" and m.indexes != tuple(range(n)):
            raise RefusedError(Refusal.BAD_REQUEST, "with policy scope submit all cases are played at once")
        if how.policy_scope == "submit" and how.hidden_evaluation == "pool":
            check_job(m.cases, n)
        return EvaluationRow(
            evaluation=f"e-{secrets.token_hex(8)}",
            key=m.key,
            env=settings.env,
            bundle=bundle,
            split="heldout",
            # They continue the ids of the held-out split, so that no policy seed is used twice.
            case_ids=tuple(ids[index] for index in m.indexes),
            cases=tuple(m.cases[index] for index in m.indexes),
            secret=of.secret,
            record="actions",
            tier=settings.sandbox_tier,
            limits=settings.limits,
            fingerprint_class=m.fingerprint_class or None,
            definition=settings.definition,
            as_in=place,
            max_steps=of.max_steps,
            # Related to all runs that share hidden cases with this one: their agents may be alive.
            related=() if is_random else (*of.validation, *of.heldout),
        )

    @_wrong_settings_refused()
    def further_cases(self, m: operator.FurtherCasesRequest) -> operator.FurtherCases:
        """Derives hidden cases for a re-score of a finished run."""
        if not 1 <= m.n <= MAX_EPISODES_PER_SUBMIT:
            raise ConfigError(f"{m.n:,} cases; 1 to {MAX_EPISODES_PER_SUBMIT:,} are re-scored at once")
        of, _ = self._reader.finished_with_result(m.run)
        env, taken = of.settings.env, (*of.train, *of.validation, *of.heldout)
        cases = self._source.further(catalogue.suite_of(env).name, env, m.name, m.n, taken)
        if cases.epoch in self._reader.revealed():
            text = reason_text(because("epoch_revealed", epoch=cases.epoch), self._reader.state)
            raise RefusedError(Refusal.BAD_REQUEST, text)
        return cases

    @_wrong_settings_refused()
    def split_hashes(self, m: operator.DescribeEnvironment, of: RunRow | None) -> dict[str, str]:
        """SHA-256 of each split of an environment.

        `of`: the finished run in question, whose own hashes are returned when its cases came from a secret."""
        if of is not None and _has_derived_cases(of):
            return of.split_hashes
        return self._splits(m.env, m.n_validation, m.n_heldout).hashes()

    def _splits(
        self, env: str, n_validation: int | None, n_heldout: int | None, own: str = ""
    ) -> EnvironmentSplits:
        """The cases of an environment. A number of None is the suite's, or that of all cases in the files."""
        if min(1 if n is None else n for n in (n_validation, n_heldout)) < 1:
            raise ConfigError("a run needs at least one validation and one held-out case")
        suite = catalogue.suite_of(env)
        wanted: dict[Split, int | None] = {"validation": n_validation, "heldout": n_heldout}
        counts: dict[Split, int] = {}
        if not self._source.from_files:
            counts = {"train": suite.n_train, "validation": suite.n_validation, "heldout": suite.n_heldout}
        counts |= {split: n for split, n in wanted.items() if n is not None}
        return self._source.splits(suite.name, env, counts, own)


def _started(reader: ServiceReader, wanted: RunSettings) -> tuple[RunSettings, tuple[Case, ...]]:
    """The settings with the run's start as the coordinator knows it, and the hidden cases of the runs before it.

    Raises ConfigError for a start that is not as its gateway recorded it."""
    start = wanted.start
    assert start is not None
    parent, submit, state = reader.parent(start)
    where = f"start from submit {start.submit_index} of run {start.run}"
    if parent is None or submit is None:
        raise ConfigError(f"{where}: this coordinator has no such submit; name a run that it has played")
    if not submit.tree or submit.tree != start.tree:
        raise ConfigError(
            f"{where}: tree {start.tree or 'none'} is not the one recorded at the submit,"
            f" {submit.tree or 'none'}: restore the run's folder, or name another submit"
        )
    if parent.settings.env != wanted.env:
        raise ConfigError(
            f"{where}: it is a run on {parent.settings.env}, not {wanted.env}; name its environment"
        )
    before, ended = parent.settings.start, state is not None and state.phase != "open"
    line = _conditions(parent, {} if state is None else state.agent)
    if before is not None:
        line = line.weakest(before.line)
    scored = ended or (before is not None and before.parent_scored)
    related = (*parent.validation, *parent.heldout, *parent.related)
    return replace(wanted, start=replace(start, parent_scored=scored, line=line)), related


def _conditions(row: RunRow, agent: dict[str, object]) -> Line:
    """The conditions of one run. `agent`: as its gateway told when it closed; empty while it is open."""
    told, own = agent.get("record"), Line(sandbox_tier=row.settings.sandbox_tier)
    if not isinstance(told, dict):
        return own
    told_agent = told.get("agent")
    use = told_agent.get("model_use") if isinstance(told_agent, dict) else None
    counted_by = use.get("metering") if isinstance(use, dict) else None
    metering = metering_of(
        counted_by, told_agent.get("model_string") if isinstance(told_agent, dict) else None
    )
    own = replace(own, jail=told.get("jail"), metering=metering)
    return own.weakest(own)  # of known words alone: a gateway may tell anything


def _has_derived_cases(run: RunRow | None) -> bool:
    """Whether a run's cases came from a secret; its coordinator may have another one now (`splits.secret_of`)."""
    return run is not None and run.split_hashes.keys() == set(SPLITS)


def run_secret(state: Path, key: str) -> bytes:
    """The secret from which the random numbers of a run's policies follow."""
    return of_run(state, "secret", key)


def _max_steps(env: str, step_limit: StepLimit) -> int:
    """Steps after which an episode is truncated; 0: only the environment ends it."""
    return (catalogue.entry(env).published_steps or 0) if step_limit == "published" else 0
