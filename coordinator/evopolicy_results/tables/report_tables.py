"""The report's tables, made from a `Study`: the paper's, and further diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_results.behaviour import structure
from evopolicy_results.behaviour.audit import TokenUse
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.reading.environments import family_of, family_title, grouped, suite_size, title_of
from evopolicy_results.scoring.normalised import DEMANDS, on_known_scale
from evopolicy_results.scoring.ranking import CellResult, Incomplete, Standing
from evopolicy_results.statistics.generalisation import mean_of_all
from evopolicy_results.statistics.standings import RankEstimate
from evopolicy_results.studies.study import Study, Suite
from evopolicy_results.tables.run_tables import (
    ENTRY,
    ENV,
    HARNESS,
    RUN,
    RUNS,
    one_or_all,
    tables_of_runs,
)
from evopolicy_results.tables.statistics_tables import (
    INTERVAL,
    OVER,
    checkpoints,
    starts_table,
    statistics_tables,
)
from evopolicy_results.tables.table import Column, Table, best_marks, interval_text, span, tabulated

_DEMAND = Column("demand", "Demand")
_BUDGET = Column("budget", "Budget", "integer", note="Train episodes of a run.")
_KNOWN = Column(
    "known",
    "Normalised",
    "number",
    digits=2,
    note="0: random actions, 1: the best known policy, as measured in the catalogue. May exceed 1.",
)


def tables_of(study: Study) -> list[Table]:
    """Every table of the report in order. Tables without rows are omitted, except for `left_out`."""
    tables: list[Table] = []
    for suite in study.suites:
        tables += [_aggregate(suite, study), _incomplete(suite), _heldout(suite), _cells(suite)]
        tables += [*statistics_tables(suite), _normalised(suite)]
    scored = [*tables, _worlds(study)]
    if study.post_hoc:
        scored = [replace(table, caption=f"{table.caption} {study.post_hoc}") for table in scored]
    tables = [
        *scored[:-1],
        starts_table(study.starts),
        scored[-1],
        _evolution(study),
        _edit_types(study),
        _structure(study),
        _edit_sizes(study),
        _tokens(study),
        *tables_of_runs(study),
    ]
    return [table for table in tables if table.rows or table.name == "left_out"]


def _aggregate(suite: Suite, study: Study) -> Table:
    families = list(dict.fromkeys(family_of(env) for env in suite.board.environments))
    # Families that do not ship could have the name of another column.
    keys = {each: each if each in catalogue.families() else f"family_{each}" for each in families}
    keys = keys if len(keys) > 1 else {}
    here = (run for run in study.runs if run.env in suite.board.environments)
    by_entry = grouped(here, lambda run: run.entry)
    budgets = {entry: one_or_all(sorted(run.budget for run in runs)) for entry, runs in by_entry.items()}
    whole = suite_size(suite.name) or len(suite.board.environments)
    standings = suite.statistics.standings
    rows: list[dict[str, Any]] = [
        {
            "entry": row.entry,
            "harness": row.harness,
            **{key: row.families.get(family) for family, key in keys.items()},
            "score": row.score,
            **_uncertainty(standings.of(row.entry)),
            "known": _known_mean(suite, row.entry),
            "rank": row.rank,
            "budget": None if row.is_reference else budgets.get(row.entry),
            "wins": row.wins,
            "top2": row.top2,
            "environments": f"{row.n_environments} of {whole}",
            "runs": None if row.is_reference else row.n_runs,
        }
        for row in suite.board.standings
    ]
    note = "Entries that share a letter do not differ significantly."
    columns = (
        ENTRY,
        HARNESS,
        *(Column(key, family_title(family), "number") for family, key in keys.items()),
        Column("score", suite.title, "number"),
        *(
            (Column("score_interval", INTERVAL), Column("rank_interval", "Rank interval"))
            if standings.rows
            else ()
        ),
        *((Column("ties", "Tie group", note=note),) if standings.rows else ()),
        *((_KNOWN,) if any(row["known"] is not None for row in rows) else ()),
        *((_BUDGET,) if budgets else ()),
        Column("wins", "Wins", "integer", note="Environments on which it ranks first."),
        Column("top2", "Top-2", "integer", note="Environments on which it ranks first or second."),
        Column("environments", "Environments"),
        RUNS,
    )
    caption = (
        "Rank scores: within each environment entries are ranked by held-out mean return, ties sharing the better rank,"
        " and s = 1 − (rank − 1)/(N − 1); families and the suite are means over their environments."
    )
    caption += " Budget: train episodes of a run." if budgets else ""
    if standings.rows:
        caption += (
            f" 95 % interval: of the rank score that a repetition with new {standings.over} would give on average. Tie"
            " group: entries that share a letter do not differ significantly (all pairs together at 5 %, Holm); the"
            f" rank interval is what these comparisons leave.{checkpoints(suite)}"
        )
    return Table(
        name=f"leaderboard_{suite.name}",
        title=f"{suite.title} leaderboard",
        caption=caption,
        columns=columns,
        rows=tuple(rows),
        marks=best_marks(rows, [*keys.values(), "score"]),
    )


def _uncertainty(row: RankEstimate | None) -> dict[str, Any]:
    if row is None:
        return {}
    interval = span(row.score_low, row.score_high, 3) if row.score_low < row.score_high else None
    return {
        "score_interval": interval or "no spread: the same in each draw",
        "rank_interval": f"{row.rank_low} to {row.rank_high}",
        "ties": row.ties,
    }


def _incomplete(suite: Suite) -> Table:
    n = len(suite.board.environments)
    return tabulated(
        suite.board.incomplete,
        (
            ENTRY,
            HARNESS,
            Column("environments", "Environments", of=lambda one: f"{one.n_environments} of {n}"),
            Column("missing", "Not played", of=lambda one: ", ".join(map(title_of, one.missing))),
            replace(RUNS, of=lambda one: None if one.is_reference else one.n_runs),
        ),
        name=f"incomplete_{suite.name}",
        title=f"{suite.title} incomplete entries",
        caption=(
            "Entries that have not played every environment of this report are not ranked and have no mean over"
            " environments: it would not be comparable. Their returns are in the tables of single environments and of"
            " differences."
        ),
    )


def _heldout(suite: Suite) -> Table:
    rows: list[dict[str, Any]] = []
    marks: dict[tuple[int, str], int] = {}
    standings: list[Standing | Incomplete] = [*suite.board.standings, *suite.board.incomplete]
    for i, standing in enumerate(standings):
        row: dict[str, Any] = {"entry": standing.entry, "harness": standing.harness}
        for env in suite.board.environments:
            if (cell := suite.board.cells.get((standing.entry, env))) is not None:
                row[env] = cell.mean
                if cell.mean is not None and cell.rank in (1, 2) and len(suite.board.standings) > 1:
                    marks[i, env] = cell.rank
        rows.append(row)
    columns = [Column(env, title_of(env), "number") for env in suite.board.environments]
    return Table(
        name=f"heldout_{suite.name}",
        title=f"{suite.title} held-out returns",
        caption=(
            "Mean return of the validation-selected policy on the held-out cases, in each environment's own units:"
            " compare within a column only. Best and second-best are marked. The random reference plays the same cases."
            " A dash is a cell that was not run, or a run with no ok submit. Incomplete entries come last, without"
            " marks."
        ),
        columns=(ENTRY, HARNESS, *columns),
        rows=tuple(rows),
        marks=marks,
    )


def _cells(suite: Suite) -> Table:
    means = suite.statistics.means

    def over(cell: CellResult) -> str | None:
        mean = means.get((cell.entry, cell.env))
        return None if mean is None or mean.low is None else mean.over

    place = {env: i for i, env in enumerate(suite.board.environments)}
    table = tabulated(
        sorted(
            suite.board.cells.values(),
            key=lambda cell: (place[cell.env], cell.rank is None, cell.rank or 0, cell.entry.casefold()),
        ),
        (
            ENV,
            Column("family", "Family", of=lambda cell: family_title(family_of(cell.env))),
            ENTRY,
            Column("mean", "Held-out mean", "number"),
            Column("interval", INTERVAL, of=lambda cell: interval_text(means.get((cell.entry, cell.env)))),
            replace(OVER, of=over),
            RUNS,
            replace(_KNOWN, of=lambda cell: on_known_scale(cell.mean, cell.env)),
            Column("rank", "Rank", "integer"),
            Column("score", "Rank score", "number"),
        ),
        name=f"cells_{suite.name}",
        title=f"{suite.title} cells",
        caption=(
            "Every entry on every environment: mean over its runs, 95 % interval of the mean over what the column Over"
            " names, rank and rank score (of entries that played every environment). Entries share their cases, so two"
            " of these intervals may overlap where the difference is sure: compare by the table of differences."
        ),
    )
    has = {"score": suite.is_ranked, "known": any(row["known"] is not None for row in table.rows)}
    return replace(table, columns=tuple(c for c in table.columns if has.get(c.key, True)))


def _normalised(suite: Suite) -> Table:
    agents = suite.table.agents
    cells = suite.normalised.cells
    groups = {(group.entry, group.demand): group for group in suite.normalised.groups}
    rows: list[dict[str, Any]] = []
    bold: dict[tuple[int, str], int] = {}
    for demand in (*DEMANDS, None):
        envs = [env for env in suite.table.environments if demand_of(env) == demand]
        for env in envs:
            values = {a: cells[a, env].value for a in agents if (a, env) in cells}
            rows.append({"demand": demand or "neither", "env": title_of(env), **values})
        if envs and demand is not None:
            means = {a: groups[a, demand].value for a in agents}
            bold |= {(len(rows), a): 1 for a in agents}
            rows.append({"demand": demand, "env": f"{demand.capitalize()} mean", **means})
    return Table(
        name=f"normalised_{suite.name}",
        title=f"{suite.title} normalised performance",
        caption=(
            "Held-out return on the random-to-best scale, clipped to 0 … 1, by dominant task demand: 0 is the random"
            " reference on the same cases, 1 the best agent on that environment. Bold: means of a group's environments."
            " A dash: no agent beats random, no reference, or no score; for a mean, no score on one of the group's"
            " environments."
        ),
        columns=(ENV, _DEMAND, *(Column(agent, agent, "number", digits=2) for agent in agents)),
        rows=tuple(rows),
        marks=bold,
    )


def _known_mean(suite: Suite, entry: str) -> float | None:
    """Mean over the suite's environments; None unless all have a scale and a score."""
    cells = [suite.board.cells.get((entry, env)) for env in suite.board.environments]
    return mean_of_all([None if cell is None else on_known_scale(cell.mean, cell.env) for cell in cells])


def _worlds(study: Study) -> Table:
    def where(scope: str) -> str:
        return title_of(scope) if scope in catalogue.entries() else family_title(scope) if scope else "All"

    def estimates(key: str, title: str) -> tuple[Column, Column]:
        return (
            Column(key, title, "number", digits=2, of=lambda row: getattr(row, key).value),
            Column(f"{key}_interval", INTERVAL, of=lambda row: interval_text(getattr(row, key), 2)),
        )

    return tabulated(
        study.worlds.paired if study.worlds is not None else (),
        (
            ENTRY,
            Column("scope", "Environments", of=lambda row: where(row.scope)),
            *estimates("unchanged", "Unchanged"),
            *estimates("worlds", "Worlds"),
            *estimates("difference", "Difference"),
            Column("n_environments", "n", "integer", note="Environments."),
            Column("n_worlds", "Worlds n", "integer"),
        ),
        name="worlds",
        title="Environments and their worlds",
        caption=(
            "Held-out return with random actions at 0 and the best known policy at 1, not clipped: in the unchanged"
            " environments, the mean over their worlds, and the difference. Intervals: over new worlds, runs, and cases"
            " in the same environments (unchanged: over runs and cases, or the cases of single runs). An entry counts"
            " on environments where it has a score in all worlds of the report; compare entries with equal n only. The"
            " difference grows with knowledge that the worlds do not confirm, and with too little exploration."
        ),
    )


def _evolution(study: Study) -> Table:
    return tabulated(
        study.evolutions,
        (
            ENV,
            ENTRY,
            RUN,
            Column("submits", "Scored submits", "integer", of=lambda one: len(one.steps)),
            Column(
                "best",
                "Best validation mean",
                "number",
                of=lambda one: one.steps[-1].best if one.steps else None,
            ),
            Column(
                "improvements",
                "Improvements",
                "integer",
                note="Rises after the first score.",
                of=lambda one: one.n_improvements,
            ),
            Column("area", "Area", "number", digits=2),
            Column("to_50", "To 50 % (episodes)", "integer"),
            Column("to_80", "To 80 % (episodes)", "integer"),
        ),
        run=lambda one: one.run,
        name="evolution",
        title="Score evolution of each run",
        caption=(
            "Best validation mean so far over the budget. Scale of each environment: 0 is the random reference, 1 the"
            " best validation mean of any run. Area: mean of the curve over the budget. To 50 % and 80 %: train"
            " episodes consumed when the curve first gets there. Validation is hidden from agents during the run."
        ),
    )


def _edit_types(study: Study) -> Table:
    harness = {run.entry: run.harness for run in study.runs}

    def count(key: str, title: str, note: str) -> Column:
        return Column(key, title, "integer", note=note)

    return tabulated(
        study.edit_rates,
        (
            ENTRY,
            Column("harness", "Harness", of=lambda row: harness[row.entry]),
            _DEMAND,
            count("n_synthesis", "Synthesis n", "New topology."),
            Column("hit_synthesis", "Synthesis hit", "percent", of=lambda row: row.rate_synthesis),
            count("n_parametric", "Parametric n", "Same topology, other bytes."),
            Column("hit_parametric", "Parametric hit", "percent", of=lambda row: row.rate_parametric),
            count("n_rollback", "Rollback", "Back to an earlier topology."),
            count("n_retest", "Retest", "Byte-identical."),
            count("n_data", "Data only", "Files outside the source bundle changed, such as weights."),
            count("n_first", "First", "First score-bearing submit of a run."),
            count("n_not_ok", "Not ok", "Accepted submits without a working policy."),
            count("n_unscored", "Unscored", "Ok, without a validation mean."),
        ),
        name="edit_types",
        title="Edit types",
        caption=(
            "Each score-bearing submit against the one before it. Synthesis: a numeric-constant-stripped AST topology"
            " that is new to the run. Parametric: bytes changed, topology kept. A hit raises the validation best so"
            " far. The other columns are excluded from both rates: rollbacks to an earlier topology, byte-identical"
            " retests, submits that changed data files only, the first score-bearing submit (it follows none), submits"
            " that are not ok, and ok ones without a validation score."
        ),
    )


def _structure(study: Study) -> Table:
    keys = (*structure.FEATURES, "nodes", "lines")
    titles = ("Funcs", "Branches", "Loops", "Depth", "State", "AST nodes", "Lines")
    return tabulated(
        study.structure,
        (
            _DEMAND,
            ENTRY,
            HARNESS,
            *(Column(k, t, "number", digits=1) for k, t in zip(keys, titles, strict=True)),
            RUNS,
        ),
        name="structure",
        title="Realised structure",
        caption=(
            "AST features of the validation-selected policies (policy.py and the local modules it reaches), mean over "
            "environments of a demand group. State counts attributes that methods assign on their instance."
        ),
    )


def _edit_sizes(study: Study) -> Table:
    return tabulated(
        [row for row in study.edit_sizes if row.n],
        (
            ENTRY,
            Column("lines", "Changed lines", of=lambda row: row.label),
            Column("n", "Transitions", "integer"),
            Column("p_visible", "Visible mean improved", "percent"),
            Column("p_validation", "Validation best improved", "percent"),
        ),
        name="edit_sizes",
        title="Edit size and improvement",
        caption=(
            "Transitions between adjacent score-bearing submits by lines added and removed in the source bundle."
            " Visible: the train mean rose (a retest may play other cases). Validation: the validation best rose, which"
            " an unchanged policy cannot. Data only: files outside the source bundle changed, such as weights."
        ),
    )


def _tokens(study: Study) -> Table:
    def millions(
        key: str, title: str, note: str, of: Callable[[TokenUse], float | None] | None = None
    ) -> Column:
        return Column(key, title, "number", digits=2, below=True, note=note, of=of)

    return tabulated(
        study.tokens if any(row.n_runs for row in study.tokens) else (),
        (
            ENV,
            ENTRY,
            millions("input", "In (M)", "Non-cached input.", lambda row: row.input_noncached),
            millions("cache", "Cache (M)", "Cache read plus cache creation."),
            millions("output", "Out (M)", "Output, reasoning included."),
            Column("cost", "Cost (US$)", "number", digits=2),
            Column("runs", "Runs that tell", "integer", of=lambda row: row.n_runs),
            Column("metering", "Counted by", of=lambda row: row.metering or None),
            Column(
                "hosted_tools",
                "Tools of the provider",
                note="Offered to the model: the provider runs them, such as a search of the web.",
                of=lambda row: row.hosted_tools or None,
            ),
            Column(
                "differing",
                "Runs whose agent counts otherwise",
                "integer",
                note="By more than 5 %.",
                of=lambda row: row.differing if "relay" in row.metering else None,
            ),
        ),
        name="tokens",
        title="Tokens and cost",
        caption=(
            "Mean of a run, in millions of tokens. In: input that no cache served. Cache: cache read and creation. Out:"
            " output with reasoning. Diagnostic only, no part of a score. A dash: nothing counted them. Counted by the"
            " relay: at the wire; by the agent: as its program reports."
        ),
    )
