"""Reads run directories of the published software as our records; missing information stays unknown, never guessed.

Its `run.json` has `schema_version` 0.1 and no `record_version`. Only fields named by the published protocol are used,
and each may be missing: names then come from the path, the budget from the first checkpoint, the selected submit from
`code_metrics_best`. Properties of every published run are filled in: one policy for all episodes of a submit, list
observations, no simulation outside submits, its step limits, no early finish, public cases.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_common.messages.run_settings import HIDDEN_COUNTS
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA
from evopolicy_common.records.policies.checkpoints import read_meta
from evopolicy_common.records.run_record import (
    Agent,
    Artifacts,
    ExperimentDimensions,
    Outcome,
    RunRecord,
    Timing,
    Versions,
)
from evopolicy_common.regular_files import read_regular

PUBLISHED = 0
"""`record_version` of a record that was read from the published software's files."""
HARNESS = "published software"
UNKNOWN = "unknown"

_HASHES = ("agents_md_hash", "data_train_hash", "data_valid_hash", "data_heldout_hash")
_ARTIFACTS = ("workspace", "feedback", "checkpoints", "logs_harness", "logs_agent", "logs_env")


class PublishedSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The fields of a published `summary.json` that a report uses; each may be missing."""

    status: str = ""
    env: str = ""
    env_instances: tuple[int, ...] = ()
    remaining_budget: int | None = None
    mean_return: float | None = None
    errors: tuple[int, ...] | None = None
    submit_started_at: str = ""

    @property
    def n_episodes(self) -> int:
        return len(self.env_instances)


def read_summary(path: Path) -> PublishedSummary | None:
    """A submit's summary; None when it is missing. Raises ProtocolError when it is damaged."""
    try:
        return msgspec.json.decode(read_regular(path), type=PublishedSummary)
    except FileNotFoundError:
        return None
    except (OSError, *DECODE_ERRORS) as error:
        raise ProtocolError(f"{path.parent.name}/{path.name}: not a submit summary: {error}") from error


def read_record(folder: Path, data: bytes) -> RunRecord | None:
    """Converts the bytes of a `run.json` of the published software to our record; None for one of ours. Raises
    ProtocolError when it is damaged, or no JSON, which has no NaN, half characters or numbers beyond floats."""
    with raised_as(ProtocolError, "not a run record", *DECODE_ERRORS):
        record = msgspec.json.decode(data)
    ours = not isinstance(record, dict) or "record_version" in record
    if ours or record.get("schema_version") != PUBLISHED_SCHEMA:
        return None
    outcome, timing, versions = (_object(record, name) for name in ("outcome", "timing", "versions"))
    artifacts = {name: place for name, place in _object(record, "artifacts").items() if name in _ARTIFACTS}
    feedback = folder / str(artifacts.get("feedback", "workspace/feedback"))
    summaries = list(filter(None, map(read_summary, sorted(feedback.glob("submit_*/summary.json")))))
    model, env = _names(folder, record, summaries)
    heldout = outcome.get("heldout_returns") or ()
    with raised_as(ProtocolError, "not a published run record", msgspec.ValidationError, TypeError):
        has_published_cases = len(heldout) == HIDDEN_COUNTS["published-data"][1]
        return RunRecord(
            record_version=PUBLISHED,
            protocol_version=str(record.get("protocol_version", UNKNOWN)),
            model=model,
            env=env,
            exp_id=str(record.get("exp_id", folder.name)),
            agent=Agent(entry=model, harness=HARNESS),
            sandbox_tier="none",
            jail=UNKNOWN,
            experiment_dimensions=ExperimentDimensions(
                episode_budget=_budget(folder, record, summaries),
                min_episodes_per_submit=0,
                max_episodes_per_submit=0,
                policy_scope="submit",
                observations="lists",
                n_train=0,
                n_validation=0,
                n_heldout=len(heldout),
                simulation="forbidden",
                finish="budget",
                step_limit="published",
                failed_episodes="end-submit",
                hidden_evaluation="pool",
                profile="published-data" if has_published_cases else "published",
            ),
            timing=msgspec.convert(timing, Timing),
            outcome=msgspec.convert(
                {
                    **{name: outcome.get(name) for name in ("error", "final_score", "val_scores")},
                    "status": outcome.get("status") or "error",
                    "best_submit_index": _best(outcome),
                    "heldout_returns": heldout,
                },
                Outcome,
            ),
            artifacts=msgspec.convert(artifacts, Artifacts),
            versions=msgspec.convert(
                {
                    **{name: str(versions.get(name, UNKNOWN)) for name in ("harness", "env")},
                    **{name: str(versions.get(name, "")) for name in _HASHES},
                    "data_secret": False,
                },
                Versions,
            ),
        )


def _object(fields: dict[str, object], name: str) -> dict[str, Any]:
    value = fields.get(name)
    return value if isinstance(value, dict) else {}


def _names(folder: Path, record: dict[str, object], summaries: list[PublishedSummary]) -> tuple[str, str]:
    """Model and environment: as recorded, or from `runs/<model>/<env>/<exp-id>`, where `_` may replace an
    environment's `/`."""
    above, two_above = folder.parent, folder.parent.parent
    by_path = {env: two_above.name for env in catalogue.entries() if env.replace("/", "_") == above.name}
    whole = f"{two_above.name}/{above.name}"
    by_path |= {env: two_above.parent.name for env in catalogue.entries() if env == whole}
    env = record.get("env") or next((one.env for one in summaries if one.env), None)
    env = str(env or next(iter(by_path), above.name))
    return str(record.get("model") or by_path.get(env, two_above.name)), env


def _budget(folder: Path, record: dict[str, object], summaries: list[PublishedSummary]) -> int:
    """The episode budget: as recorded, or the remaining budget before the first submit."""
    budget = _object(record, "experiment_dimensions").get("episode_budget")
    if isinstance(budget, int):
        return budget
    first = min((folder / "checkpoints").glob("submit_*"), default=None)
    meta = None if first is None else read_meta(first)
    if meta is not None:
        return meta.remaining_budget_before
    known = (one.remaining_budget + one.n_episodes for one in summaries if one.remaining_budget is not None)
    return next(known, 0)


def _best(outcome: dict[str, Any]) -> int | None:
    """The selected submit: as recorded, or the best-scored one with the code metrics of the best checkpoint."""
    best = outcome.get("best_submit_index")
    if best is not None:
        return int(best)
    auxiliary, scores = _object(outcome, "auxiliary"), _object(outcome, "val_scores")
    wanted, by_submit = auxiliary.get("code_metrics_best"), _object(auxiliary, "code_metrics_by_submit")
    if wanted is None:
        return None

    def rank(index: int) -> tuple[float, int]:
        score = scores.get(str(index))
        return (float(score) if isinstance(score, int | float) else -math.inf), index

    equal = (int(index) for index, metrics in by_submit.items() if metrics == wanted and index.isdecimal())
    return max(equal, key=rank, default=None)
