"""The evaluation card of published results: what was measured, under which conditions, at what cost. Pure.

Rules that this module owns:
- A card follows from the published runs and the journal, so a check makes it again and compares the bytes.
  Only its licences are claims: those of packages belong to the version that published, `licence` is the
  publisher's word.
- Intervals of single runs are resampled, and another version of numpy may draw otherwise. A check lets their
  bounds differ by `_TOLERANCE` of an interval's width.
- `VERSION` changes when the same runs give another card, text, or description. A check lists a card of
  another version as a claim.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.catalogue.installs import Licence, family_of, licences
from evopolicy_common.messages.operator import RunResult
from evopolicy_common.records import journal
from evopolicy_common.records.aggregates import mean
from evopolicy_common.records.run_record import RunRecord, RunSummary
from evopolicy_common.records.summary import utc_text
from evopolicy_common.records.words import CANARY
from evopolicy_results.publish import contents
from evopolicy_results.scoring import scores
from evopolicy_results.statistics.pairs import cell_mean

VERSION = 3
_TOLERANCE = 0.05
_LIMITS = {
    "policies' sandbox": (
        "bwrap",
        "In some runs, or in runs that they start from, policies ran outside the sandbox.",
    ),
    "agents' jail": (
        "bwrap",
        "In some runs, or in runs that they start from, the agent had no jail, a network, or an unknown jail.",
    ),
    "workspace": (
        "usual",
        "Some runs start from a submit of another run, whose work and budget are in their scores.",
    ),
    "agents beside hidden episodes": ("exclusive", "Some agents and hidden episodes could share a kernel."),
    "hidden cases": ("secret", "Some hidden cases are public: an agent's model may have seen them."),
    "rules": ("renewed", "Rules of some environments cannot be renewed: their scores may contain recall."),
    "episodes repeat": ("true", "Some environments do not repeat an episode from seed and actions."),
}
"""By condition: the value that limits nothing, and the limit that other values mean."""
_ALWAYS = (
    "No human played these cases: there is no human reference.",
    "A recording shows the actions that were played, not that the policy chose them.",
    "Each episode counts as one worker reported it; `evopolicy verify` plays it again elsewhere.",
    "Returns of different environments have different scales, so there is no mean over environments.",
)


class CardSource(NamedTuple):
    folder: str
    record: RunRecord
    result: RunResult


class CardCell(msgspec.Struct, frozen=True, kw_only=True):
    """All runs of an entry on an environment from one start."""

    entry: str
    env: str
    start: str = ""
    """As of `RunSummary`."""
    runs: int
    mean: float | None
    """Of the runs' scores; None where a run has none."""
    low: float | None = None
    high: float | None = None
    """Of the 95 % interval; None without one."""
    over: str = ""
    """The units that a repetition of the experiment would draw again, or why there is no interval."""
    random: float | None = None


class AgentCost(msgspec.Struct, frozen=True, kw_only=True):
    """An entry, and what all its runs used; None where a run has no count."""

    entry: str
    agents: tuple[str, ...]
    """Harness, its version, and model."""
    runs: int
    submits: int
    episodes: int
    wall_s: float
    turns: int
    cpu_s: float | None
    """Processor time of its programs."""
    tokens: int | None
    """Of all kinds."""
    cost: float | None
    """US dollars."""


class Card(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `card.json`."""

    version: int = VERSION
    canary: str = CANARY
    software: str
    """Version of evopolicy that published."""
    signer: str
    """Public key, hexadecimal."""
    journal_entries: int
    journal_head: str
    completeness: str
    licence: str
    """Of the published file; empty: not stated."""
    began: str
    ended: str
    revealed: str
    """When the cases became public, by the coordinator's clock."""
    results: tuple[CardCell, ...]
    agents: tuple[AgentCost, ...]
    conditions: dict[str, dict[str, dict[str, int]]]
    """By topic and name: each value, with the number of runs that have it."""
    limits: tuple[str, ...]
    licences: tuple[Licence, ...]
    """Of the played families."""
    runs: tuple[RunSummary, ...]
    """`run` is the folder in the published file."""


def make(
    sources: Sequence[CardSource],
    lines: Sequence[bytes],
    *,
    signer: str,
    software: str,
    licence: str = "",
    claimed: Sequence[Licence] | None = None,
) -> Card:
    """The card of some published runs. `lines`: the journal's entries. `claimed`: licences in place of this
    version's."""
    entries = [journal.read_entry(line) for line in lines]
    revealed = [each.at for each in entries if isinstance(each, journal.Revealed)]
    records = [each.record for each in sources]
    cells: dict[tuple[str, str, str], list[CardSource]] = {}
    by_entry: dict[str, list[CardSource]] = {}
    for each in sources:
        record = each.record
        start = "" if record.start is None else record.start.text
        cells.setdefault((record.env, record.agent.entry, start), []).append(each)
        by_entry.setdefault(record.agent.entry, []).append(each)
    conditions = _conditions(records)
    scores = [[each.record.outcome.score for each in cell] for cell in cells.values()]
    return Card(
        software=software,
        signer=signer,
        journal_entries=len(lines),
        journal_head=journal.heads(lines)[-1] if lines else journal.EMPTY_HEAD,
        completeness=contents.completeness(contents.listing(entries, [each.result.run for each in sources])),
        licence=licence,
        began=min(record.timing.start_time for record in records),
        ended=max(record.timing.end_time for record in records),
        revealed=utc_text(max(revealed)) if revealed else "",
        results=tuple(_cell(*key, each) for key, each in sorted(cells.items())),
        agents=tuple(_agent(entry, each) for entry, each in sorted(by_entry.items())),
        conditions=conditions,
        limits=_limits(conditions, scores),
        licences=tuple(
            licences(map(family_of, {record.env for record in records})) if claimed is None else claimed
        ),
        runs=tuple(each.record.summary(each.folder) for each in sources),
    )


def _cell(env: str, entry: str, start: str, sources: Sequence[CardSource]) -> CardCell:
    """With the interval of reports (`docs/explanation/statistics.md`)."""
    runs = []
    for _, record, result in sources:
        is_shared = record.experiment_dimensions.hidden_cases == "shared"
        cases, score = record.versions.cases_hash("heldout") if is_shared else "", record.outcome.score
        returns = result.heldout_returns if score is not None else ()
        selected = (each for each in result.submits if each.submit_index == result.best_submit_index)
        policy = next((each.bundle for each in selected), None) or ""
        runs.append(scores.RunReturns(score=score, returns=returns, case_set=cases, policy=policy))
    cell = scores.Cell(entry=entry, env=env, runs=tuple(runs))
    estimate, over = cell_mean(cell), "a run has no score"
    if estimate is not None:
        over = "; ".join(filter(None, (estimate.reason or estimate.over, cell.repeated)))
    outcomes = [each.record.outcome for each in sources]
    measured = [each.score for each in outcomes if each.score is not None]
    random = [each.random_score for each in outcomes if each.random_score is not None]
    return CardCell(
        entry=entry,
        env=env,
        start=start,
        runs=len(sources),
        mean=mean(measured) if estimate else None,
        low=estimate.low if estimate else None,
        high=estimate.high if estimate else None,
        over=over,
        random=mean(random) if random else None,
    )


def _agent(entry: str, sources: Sequence[CardSource]) -> AgentCost:
    agents = [each.record.agent for each in sources]
    used = [agent.resources.cpu_s for agent in agents if agent.resources is not None]
    tokens = [agent.tokens for agent in agents if agent.tokens is not None]
    costs = [each.cost for each in tokens if each.cost is not None]
    named = [(agent.harness, agent.cli_version, agent.model_string) for agent in agents]
    return AgentCost(
        entry=entry,
        agents=tuple(dict.fromkeys(" ".join(filter(None, each)) for each in named)),
        runs=len(sources),
        submits=sum(len(each.result.submits) for each in sources),
        episodes=sum(each.result.budget_used for each in sources),
        wall_s=round(sum(each.record.timing.wall_time_seconds for each in sources), 3),
        turns=sum(agent.turns for agent in agents),
        cpu_s=round(sum(used), 3) if len(used) == len(sources) else None,
        tokens=sum(each.total for each in tokens) if len(tokens) == len(sources) else None,
        cost=sum(costs) if len(costs) == len(sources) else None,
    )


def _conditions(records: Sequence[RunRecord]) -> dict[str, dict[str, dict[str, int]]]:
    counts: dict[str, dict[str, Counter[str]]] = {}
    for record in records:
        versions = record.versions
        settings: dict[str, Any] = msgspec.to_builtins(record.experiment_dimensions)
        limits, resources = settings.pop("limits") or {}, record.agent.resources
        entry = catalogue.known_entry(record.env)
        topics: dict[str, dict[str, Any]] = {
            "isolation": {
                "policies' sandbox": record.line.sandbox_tier,
                "agents' jail": record.line.jail,
                "workspace": "usual" if record.start is None else "of an earlier submit",
                "agents beside hidden episodes": record.hidden_isolation,
                "hidden cases": "secret" if versions.data_secret else "public",
                "rules": "renewed" if entry is not None and entry.world else "fixed",
            },
            "metering": {"tokens counted by": record.line.metering},
            "hardware": {"processor": versions.fingerprint.get("cpu")},
            "agents' limits": msgspec.to_builtins(resources.limits) if resources else {},
            "software": {**versions.fingerprint, "cpu": None, "episodes repeat": versions.env_deterministic},
            "settings": {**settings, **limits, "protocol": record.protocol_version},
        }
        for topic, values in topics.items():
            for name, value in values.items():
                if value not in (None, ""):
                    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
                    counts.setdefault(topic, {}).setdefault(name, Counter())[text] += 1
    return {topic: {name: dict(n) for name, n in names.items()} for topic, names in counts.items()}


def _limits(
    conditions: Mapping[str, Mapping[str, Mapping[str, int]]], scores: Sequence[Sequence[float | None]]
) -> tuple[str, ...]:
    """`scores`: of the runs of each cell."""
    values = {name: each for names in conditions.values() for name, each in names.items()}
    limits = [text for name, (good, text) in _LIMITS.items() if values.get(name, {}).keys() - {good}]
    if any(len(each) == 1 for each in scores):
        limits.append("Cells of one run compare checkpoints, not agents: the spread between runs is unknown.")
    if any(len(each) > 1 == len(set(each)) for each in scores):
        limits.append("All runs of some cells have one score: they may be copies, and intervals too narrow.")
    if "agent" in values["tokens counted by"]:
        limits.append("Some token counts are the agent's own: nothing checked them.")
    return (*limits, *_ALWAYS)


def matching(own: Card, claimed: Card) -> Card:
    """`own`, with bounds of intervals in `claimed` that are close enough."""
    cells = [_nearest(*each) for each in zip(own.results, claimed.results, strict=False)]
    return msgspec.structs.replace(own, results=(*cells, *own.results[len(cells) :]))


def _nearest(ours: CardCell, theirs: CardCell) -> CardCell:
    if ours.low is None or ours.high is None or theirs.low is None or theirs.high is None:
        return ours
    apart = max(abs(ours.low - theirs.low), abs(ours.high - theirs.high))
    is_close = apart <= _TOLERANCE * (ours.high - ours.low)
    return msgspec.structs.replace(ours, low=theirs.low, high=theirs.high) if is_close else ours
