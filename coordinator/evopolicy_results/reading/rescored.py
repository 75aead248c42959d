"""Replaces runs' held-out results by those of a re-score (`rescore/NAME.json`). The selection stays the run's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from evopolicy_common.errors import ConfigError, ProtocolError
from evopolicy_common.messages.environment import Split
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.rescores import Rescored, RescoreRecord, read_rescore
from evopolicy_common.records.run_record import PolicyFailureRecord, ReferenceScore
from evopolicy_results.reading.records import Run

_SHOWN = 4
_HELDOUT: Split = "heldout"


def rescored(runs: Sequence[Run], name: str) -> list[Run]:
    """The runs with the held-out results of their re-score `name`; runs without a selected checkpoint stay as they are.

    Raises ConfigError when a run has no such re-score, or one of another run.
    """
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


def _replaced(run: Run, record: RescoreRecord, played: Rescored) -> Run:
    outcome, versions = run.record.outcome, run.record.versions
    failures = tuple(each for each in outcome.policy_failures if each.split != _HELDOUT)
    categories: dict[str, Any] = {**played.failures}
    failures += tuple(
        PolicyFailureRecord(
            split=_HELDOUT, submit_index=record.selected, episode=int(case), category=category
        )
        for case, category in sorted(categories.items())
    )
    random = record.random_returns
    reference = ReferenceScore(
        mean_return=mean(random), std_return=std(random), returns=tuple(random), seeded_by="case"
    )
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
            policy_failures=failures,
            random_reference=reference,
        ),
        experiment_dimensions=replace(run.record.experiment_dimensions, n_heldout=record.n_cases),
        versions=replace(
            versions,
            cases_hashes={**versions.cases_hashes, _HELDOUT: record.cases_hash},
            data_secret=versions.data_secret and record.cases_secret,
        ),
    )
    return replace(run, record=replaced, rescore=record)
