"""The report's tables, made from a `Study`: the paper's, and further diagnostics."""

from __future__ import annotations

from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_results.behaviour.edits import FEATURES, demand_of
from evopolicy_results.reading.environments import family_of, family_title, grouped, suite_size, title_of
from evopolicy_results.scoring.evolution import Evolution
from evopolicy_results.scoring.scores import DEMANDS, Cell, mean_of_all, on_known_scale
from evopolicy_results.statistics.intervals import bounds_text, decimals
from evopolicy_results.studies.study import Study, SuiteStudy
from evopolicy_results.tables.run_tables import ENTRY, ENV, HARNESS, RUN, RUNS, one_or_all, tables_of_runs
from evopolicy_results.tables.statistics_tables import OVER, checkpoints, starts_table, statistics_tables
from evopolicy_results.tables.table import (
    INTERVAL,
    Column,
    Table,
    best_marks,
    interval_text,
    of_suites,
    tabulated,
    with_interval,
)

_DEMAND = Column("demand", "Demand")
_BUDGET = Column("budget", "Budget", "integer", note="Train episodes of a run.")
_KNOWN = Column(
    "known",
    "Normalised",
    "number",
    digits=2,
    note="0: random actions, 1: the best known policy, as measured in the catalogue. May exceed 1.",
)


MEANS = frozenset({"leaderboard", "incomplete", "aggregates", "improvement", "normalised"})
"""Tables of means over environments."""


def tables_of(study: Study) -> list[Table]:
    """Every table of the report in order. Tables without rows are omitted, except for `left_out`."""
    kinds: dict[str, list[tuple[SuiteStudy, Table]]] = {}
    for suite in study.suites:
        own = (_aggregate(suite, study), _incomplete(suite), _heldout(suite), _cells(suite))
        for table in (*own, *statistics_tables(suite), _normalised(suite)):
            if table.rows:
                kinds.setdefault(table.name, []).append((suite, table))
    scored: list[Table] = []
    for name, several in kinds.items():
        # A mean over one environment tells no more than its return.
        ranked = [each for each in several if each[0].is_ranked] if name in MEANS else several
        scored.append(of_suites([(suite.title, table) for suite, table in ranked or several]))
    scored.append(_worlds(study))
    if study.post_hoc:
        scored = [replace(table, caption=f"{table.caption} {study.post_hoc}") for table in scored]
    tables = [
        *scored[:-1],
        starts_table(study.starts),
        scored[-1],
        *_diagnostics(study),
        *tables_of_runs(study),
    ]
    return [table for table in tables if table.rows or table.name == "left_out"]


def _aggregate(suite: SuiteStudy, study: Study) -> Table:
    families = list(dict.fromkeys(family_of(env) for env in suite.table.environments))
    # Families that do not ship could have the name of another column.
    keys = {each: each if each in catalogue.families() else f"family_{each}" for each in families}
    keys = keys if len(keys) > 1 else {}
    here = (run for run in study.runs if run.env in suite.table.environments)
    by_entry = grouped(here, lambda run: run.entry)
    budgets = {entry: one_or_all(sorted(run.budget for run in runs)) for entry, runs in by_entry.items()}
    whole = suite_size(suite.name) or len(suite.table.environments)
    standings = suite.statistics.standings
    rows: list[dict[str, object]] = []
    for row in suite.board.standings:
        known = [
            on_known_scale(suite.board.cells[row.entry, env].mean, env) for env in suite.table.environments
        ]
        rows.append(
            {
                "entry": row.entry,
                "harness": row.harness,
                **{key: row.families.get(family) for family, key in keys.items()},
                "score": row.score,
            }
        )
        if (estimate := standings.of(row.entry)) is not None:
            low, high = estimate.score_low, estimate.score_high
            rows[-1] |= {
                "score_interval": bounds_text(row.score or 0.0, low, high)
                if decimals(low, high) is not None
                else "no spread: the same in each draw",
                "rank_interval": f"{estimate.rank_low} to {estimate.rank_high}",
                "ties": estimate.ties,
            }
        rows[-1] |= {
            "known": mean_of_all(known),
            "rank": row.rank,
            "budget": None if row.is_reference else budgets.get(row.entry),
            "wins": row.wins,
            "top2": row.top2,
            "environments": f"{row.n_environments} of {whole}",
            "runs": None if row.is_reference else row.n_runs,
        }
    uncertainty = (
        Column("score_interval", INTERVAL),
        Column("rank_interval", "Rank interval"),
        Column("ties", "Tie group", note="Entries that share a letter do not differ significantly."),
    )
    columns = (
        ENTRY,
        HARNESS,
        *(Column(key, family_title(family), "number") for family, key in keys.items()),
        Column("score", suite.title, "number"),
        *(uncertainty if standings.rows else ()),
        *((_KNOWN,) if any(row["known"] is not None for row in rows) else ()),
        *((_BUDGET,) if budgets else ()),
        Column("wins", "Wins", "integer", note="Environments on which it ranks first."),
        Column("top2", "Top-2", "integer", note="Environments on which it ranks first or second."),
        Column("environments", "Environments"),
        RUNS,
    )
    caption = (
        "Which agent ranks highest over all environments? Within each environment entries are ranked by held-out"
        " mean return, ties sharing the better rank,"
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
        name="leaderboard",
        title=f"{suite.title} leaderboard",
        caption=caption,
        columns=columns,
        rows=tuple(rows),
        marks=best_marks(rows, [*keys.values(), "score"]),
    )


def _incomplete(suite: SuiteStudy) -> Table:
    n = len(suite.table.environments)
    return tabulated(
        "incomplete",
        f"{suite.title} incomplete entries",
        (
            ENTRY,
            HARNESS,
            Column("environments", "Environments", of=lambda one: f"{one.n_environments} of {n}"),
            Column("missing", "Not played", of=lambda one: ", ".join(map(title_of, one.missing))),
            replace(RUNS, of=lambda one: None if one.is_reference else one.n_runs),
        ),
        suite.board.incomplete,
        "Entries that have not played every environment of this report are not ranked and have no mean over"
        " environments: it would not be comparable. Their returns are in the tables of single environments and of"
        " differences.",
    )


def _heldout(suite: SuiteStudy) -> Table:
    rows: list[dict[str, object]] = []
    marks: dict[tuple[int, str], int] = {}
    digits: dict[tuple[int, str], int] = {}
    for i, standing in enumerate([*suite.board.standings, *suite.board.incomplete]):
        row: dict[str, object] = {"entry": standing.entry, "harness": standing.harness}
        for env in suite.table.environments:
            if (cell := suite.board.cells.get((standing.entry, env))) is not None:
                row[env] = cell.mean
                known = suite.statistics.means.get((standing.entry, env))
                if known is not None and (n := decimals(known.low, known.high)) is not None:
                    digits[i, env] = n
                if cell.mean is not None and cell.rank in (1, 2) and len(suite.board.standings) > 1:
                    marks[i, env] = cell.rank
        rows.append(row)
    columns = [Column(env, title_of(env), "number") for env in suite.table.environments]
    return Table(
        name="heldout",
        title=f"{suite.title} held-out returns",
        caption="How much does each agent's selected policy return on the hidden held-out cases? Means in each"
        " environment's"
        " own units: compare within a column only. Best and second-best are marked. The random reference"
        " plays the same cases. A dash is a cell that was not run, or a run with no ok submit. Incomplete"
        " entries come last, without marks.",
        columns=(ENTRY, HARNESS, *columns),
        rows=tuple(rows),
        marks=marks,
        digits=digits,
    )


def _cells(suite: SuiteStudy) -> Table:
    means = suite.statistics.means

    def over(cell: Cell) -> str | None:
        mean = means.get((cell.entry, cell.env))
        units = None if mean is None or mean.low is None else mean.over
        return "; ".join(filter(None, (units, cell.repeated))) or None

    place = {env: i for i, env in enumerate(suite.table.environments)}
    table = tabulated(
        "cells",
        f"{suite.title} cells",
        (
            ENV,
            Column("family", "Family", of=lambda cell: family_title(family_of(cell.env))),
            ENTRY,
            Column("mean", "Held-out mean", "number", spread=lambda cell: means.get((cell.entry, cell.env))),
            Column("interval", INTERVAL, of=lambda cell: interval_text(means.get((cell.entry, cell.env)))),
            replace(OVER, of=over),
            RUNS,
            replace(_KNOWN, of=lambda cell: on_known_scale(cell.mean, cell.env)),
            Column("rank", "Rank", "integer"),
            Column("score", "Rank score", "number"),
        ),
        sorted(
            suite.board.cells.values(),
            key=lambda cell: (place[cell.env], cell.rank is None, cell.rank or 0, cell.entry.casefold()),
        ),
        "How sure is each mean? Every entry on every environment: mean over its runs, 95 % interval of the mean over"
        " what the column Over names, rank and rank score (of entries that played every environment). Entries share"
        " their cases, so two"
        " of these intervals may overlap where the difference is sure: compare by the table of differences.",
    )
    has = {"score": suite.is_ranked, "known": any(row["known"] is not None for row in table.rows)}
    return replace(table, columns=tuple(c for c in table.columns if has.get(c.key, True)))


def _normalised(suite: SuiteStudy) -> Table:
    agents = suite.table.agents
    cells = suite.normalised.cells
    groups = {(group.entry, group.demand): group for group in suite.normalised.groups}
    rows: list[dict[str, object]] = []
    bold: dict[tuple[int, str], int] = {}
    for demand in (*DEMANDS, None):
        envs = [env for env in suite.table.environments if demand_of(env) == demand]
        for env in envs:
            values = {a: cells[a, env] for a in agents if (a, env) in cells}
            rows.append({"demand": demand or "neither", "env": title_of(env), **values})
        if envs and demand is not None:
            means = {a: groups[a, demand].value for a in agents}
            bold |= {(len(rows), a): 1 for a in agents}
            rows.append({"demand": demand, "env": f"{demand.capitalize()} mean", **means})
    return Table(
        name="normalised",
        title=f"{suite.title} normalised performance",
        caption="Held-out return on the random-to-best scale, clipped to 0 … 1, by dominant task demand: 0 is"
        " the random reference on the same cases, 1 the best agent on that environment. Bold: means of a"
        " group's environments. A dash: no agent beats random, no reference, or no score; for a mean, no"
        " score on one of the group's environments.",
        columns=(ENV, _DEMAND, *(Column(agent, agent, "number", digits=2) for agent in agents)),
        rows=tuple(rows),
        marks=bold,
    )


def _worlds(study: Study) -> Table:
    def where(scope: str) -> str:
        return title_of(scope) if scope in catalogue.entries() else family_title(scope) if scope else "All"

    return tabulated(
        "worlds",
        "Environments and their worlds",
        (
            ENTRY,
            Column("scope", "Environments", of=lambda row: where(row.scope)),
            *with_interval("unchanged", "Unchanged", lambda row: row.unchanged, 2),
            *with_interval("worlds", "Worlds", lambda row: row.worlds, 2),
            *with_interval("difference", "Difference", lambda row: row.difference, 2),
            Column("n_environments", "n", "integer", note="Environments."),
            Column("n_worlds", "Worlds n", "integer"),
        ),
        study.worlds.paired if study.worlds is not None else (),
        "Held-out return with random actions at 0 and the best known policy at 1, not clipped: in the unchanged"
        " environments, the mean over their worlds, and the difference. Intervals: over new worlds, runs, and cases"
        " in the same environments (unchanged: over runs and cases, or the cases of single runs). An entry counts"
        " on environments where it has a score in all worlds of the report; compare entries with equal n only. The"
        " difference grows with knowledge that the worlds do not confirm, and with too little exploration.",
    )


def _diagnostics(study: Study) -> list[Table]:
    """Score evolution, edits, structure, and tokens: no part of a score."""
    harness = {run.entry: run.harness for run in study.runs}
    features = dict(
        zip(
            (*FEATURES, "nodes", "lines"),
            ("Funcs", "Branches", "Loops", "Depth", "State", "AST nodes", "Lines"),
            strict=True,
        )
    )
    provider = "Offered to the model: the provider runs them, such as a search of the web."

    def count(key: str, title: str, note: str, of: str = "") -> Column:
        return Column(key, title, "integer", note=note, of=of)

    def millions(key: str, title: str, note: str, of: str = "") -> Column:
        return Column(key, title, "number", digits=2, below=True, note=note, of=of)

    def best(one: Evolution) -> float | None:
        return one.steps[-1].best if one.steps else None

    return [
        tabulated(
            "evolution",
            "Score evolution of each run",
            (
                ENV,
                ENTRY,
                RUN,
                Column("submits", "Scored submits", "integer", of=lambda one: len(one.steps)),
                Column("best", "Best validation mean", "number", of=best),
                count("improvements", "Improvements", "Rises after the first score.", "n_improvements"),
                Column("area", "Area", "number", digits=2),
                Column("to_50", "To 50 % (episodes)", "integer"),
                Column("to_80", "To 80 % (episodes)", "integer"),
            ),
            study.evolutions,
            "Best validation mean so far over the budget. Scale of each environment: 0 is the random reference, 1 the"
            " best validation mean of any run. Area: mean of the curve over the budget. To 50 % and 80 %: train"
            " episodes consumed when the curve first gets there. Validation is hidden from agents during the run.",
            run=lambda one: one.run,
        ),
        tabulated(
            "edit_types",
            "Edit types",
            (
                ENTRY,
                Column("harness", "Harness", of=lambda row: harness[row.entry]),
                _DEMAND,
                count("n_synthesis", "Synthesis n", "New topology."),
                Column("hit_synthesis", "Synthesis hit", "percent", of="rate_synthesis"),
                count("n_parametric", "Parametric n", "Same topology, other bytes."),
                Column("hit_parametric", "Parametric hit", "percent", of="rate_parametric"),
                count("n_rollback", "Rollback", "Back to an earlier topology."),
                count("n_retest", "Retest", "Byte-identical."),
                count("n_data", "Data only", "Files outside the source bundle changed, such as weights."),
                count("n_first", "First", "First score-bearing submit of a run."),
                count("n_not_ok", "Not ok", "Accepted submits without a working policy."),
                count("n_unscored", "Unscored", "Ok, without a validation mean."),
            ),
            study.edit_rates,
            "Each score-bearing submit against the one before it. Synthesis: a numeric-constant-stripped AST topology"
            " that is new to the run. Parametric: bytes changed, topology kept. A hit raises the validation best so"
            " far. The other columns are excluded from both rates: rollbacks to an earlier topology, byte-identical"
            " retests, submits that changed data files only, the first score-bearing submit (it follows none), submits"
            " that are not ok, and ok ones without a validation score.",
        ),
        tabulated(
            "structure",
            "Realised structure",
            (
                *(_DEMAND, ENTRY, HARNESS),
                *(Column(key, title, "number", digits=1) for key, title in features.items()),
                RUNS,
            ),
            study.structure,
            "AST features of the validation-selected policies (policy.py and the local modules it reaches), mean over "
            "environments of a demand group. State counts attributes that methods assign on their instance.",
        ),
        tabulated(
            "edit_sizes",
            "Edit size and improvement",
            (
                ENTRY,
                Column("lines", "Changed lines", of="label"),
                Column("n", "Transitions", "integer"),
                Column("p_visible", "Visible mean improved", "percent"),
                Column("p_validation", "Validation best improved", "percent"),
            ),
            [row for row in study.edit_sizes if row.n],
            "Transitions between adjacent score-bearing submits by lines added and removed in the source bundle."
            " Visible: the train mean rose (a retest may play other cases). Validation: the validation best rose, which"
            " an unchanged policy cannot. Data only: files outside the source bundle changed, such as weights.",
        ),
        tabulated(
            "tokens",
            "Tokens and cost",
            (
                ENV,
                ENTRY,
                millions("input", "In (M)", "Non-cached input.", "input_noncached"),
                millions("cache", "Cache (M)", "Cache read plus cache creation."),
                millions("output", "Out (M)", "Output, reasoning included."),
                Column("cost", "Cost (US$)", "number", digits=2),
                Column("runs", "Runs with counts", "integer", of="n_runs"),
                Column("metering", "Counted by", of=lambda row: row.metering or None),
                Column(
                    "hosted_tools",
                    "Tools of the provider",
                    note=provider,
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
            study.tokens if any(row.n_runs for row in study.tokens) else (),
            "Mean of a run, in millions of tokens. In: input that no cache served. Cache: cache read and creation. Out:"
            " output with reasoning. Diagnostic only, no part of a score. A dash: nothing counted them. Counted by the"
            " relay: at the wire; by the agent: as its program reports.",
        ),
    ]
