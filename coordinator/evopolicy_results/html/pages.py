"""The report's pages as text: their contents and wording. Markup is in `templates/`; `write` writes the files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import msgspec
from jinja2 import DictLoader, Environment, StrictUndefined
from markupsafe import Markup, escape

from evopolicy_common.records import model_calls
from evopolicy_common.records.policies.trees import changes
from evopolicy_common.records.words import in_words
from evopolicy_results.behaviour.trace import Trace, TraceRow, diff, sources
from evopolicy_results.figures.plot import Plot, inline_svg
from evopolicy_results.figures.timelines import Row, timeline_svg
from evopolicy_results.html import notice, section, visible
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import Run, Submit
from evopolicy_results.scan.signals import TITLES, Signal
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.run_tables import submits_text
from evopolicy_results.tables.table import Column, Table, shown

_FILTER_FROM = 9
"""Number of rows from which a table has a filter."""
_RANKS_FROM = 4
"""Number of environments from which a report begins with rank scores; with fewer, returns say more."""
_LONG = 60
"""Number of characters from which a cell's text is broken into lines."""
FORMS = (("CSV", "csv"), ("Markdown", "md"), ("LaTeX", "tex"))
"""File forms of a table, with their suffixes."""


class PlayedEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """A recorded episode of one run, with the parts of it that were copied into the report."""

    run: Run
    split: str
    episode: int
    submit_index: int
    episode_return: float | None
    length: int | None
    video: str | None
    """Path of the copy, relative to the page; None when the recording is missing."""
    strip: str | None


_TEMPLATES = ("base", "macros", "index", "trace", "failed", "replays", "site_bundle", "site_episodes")


@cache
def environment() -> Environment:
    """The templates of all pages, with autoescaping."""
    folder = files(__package__).joinpath("templates")
    names = [f"{name}.html.j2" for name in _TEMPLATES]
    loader = DictLoader({name: folder.joinpath(name).read_text(encoding="utf-8") for name in names})
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=visible,
    )
    made.globals["inline"] = lambda plot: Markup(inline_svg(plot.svg, plot.name, plot.alt))
    for name in ("report.css", "report.js"):
        made.globals[name.split(".")[1]] = Markup(folder.joinpath(name).read_text(encoding="utf-8"))
    return made


def page(template: str, **values: Any) -> str:
    """A page from the template of that name."""
    return environment().get_template(f"{template}.html.j2").render(**values)


def index_page(
    study: Study,
    *,
    title: str,
    looks: Mapping[str, Look],
    tables: Sequence[Table],
    figures: Sequence[Plot],
    trace_links: Mapping[str, str],
    replay_links: Mapping[str, str],
) -> str:
    """`index.html`: every section with content, and what was left out."""
    views = {table.name: table_view(table) for table in tables}
    suites = [suite.name for suite in study.suites]
    ranked = [suite.name for suite in study.suites if suite.is_ranked]
    n_started = sum(run.record.start is not None for run in study.runs)
    n_envs = len({env for suite in study.suites for env in suite.table.environments})
    named = {figure.name: figure for figure in figures}

    def shown_figures(*names: str) -> list[Plot]:
        return [named[name] for name in names if name in named]

    def shown_tables(*names: str) -> list[dict[str, Any]]:
        return [views[name] for name in names if name in views]

    returns = [v for s in suites for v in shown_tables(f"heldout_{s}")]
    returns += [{**v, "folded": n_envs >= _RANKS_FROM} for s in suites for v in shown_tables(f"cells_{s}")]
    timelines = [figure for figure in figures if figure.group == "timelines"]
    sections: list[dict[str, Any]] = [
        section(
            "leaderboard",
            "Leaderboard",
            figures=shown_figures(*(f"rank_scores_{s}" for s in ranked)),
            tables=[v for s in ranked for v in shown_tables(f"leaderboard_{s}", f"incomplete_{s}")]
            + (returns if n_envs >= _RANKS_FROM else []),
        ),
        section(
            "statistics",
            "Statistics",
            title="How sure the scores are",
            texts=["Intervals are at 95 %. Each table says over what: the cases of one run, or runs and cases. No verdict contradicts the interval "
                   "beside it; the correction for many pairs can only withhold one."],
            figures=shown_figures(*(f"profiles_{s}" for s in suites)),
            tables=[v for s in suites for v in shown_tables(f"resolution_{s}")]
            + [v for s in ranked for v in shown_tables(f"aggregates_{s}", f"improvement_{s}")]
            + [{**v, "folded": True} for s in suites for v in shown_tables(f"pairs_{s}", f"generalisation_{s}")],
        ),
        section("starts", "Runs from one state", tables=shown_tables("starts")),
        section(
            "worlds",
            "Worlds",
            title="Environments and their worlds",
            texts=["A world is the environment with altered rules. A lower score there shows knowledge that these rules do not confirm, or too "
                   "little exploration: compare with agents that know nothing of the environments."],
            figures=shown_figures("worlds"),
            tables=shown_tables("worlds"),
        ),
        section(
            "evolution",
            "Score evolution",
            figures=shown_figures(*(f"score_evolution_{s}" for s in suites)),
            tables=shown_tables("evolution"),
        ),
        section(
            "demand",
            "Task demand",
            title="Performance by task demand",
            texts=["Synthesis-dominant tasks need machinery (perception, memory, planning); tuning-dominant ones mostly need the "
                   "right constants. This is one way to read the results, not a classification of tasks."],
            figures=shown_figures(*(f"normalised_{s}" for s in suites)),
            tables=shown_tables(*(f"normalised_{s}" for s in ranked)),
        ),
        section(
            "edits", "Edits", title="What edits do",
            figures=shown_figures("edit_hits", "edit_size"), tables=shown_tables("edit_types", "edit_sizes"),
        ),
        section(
            "timelines", "Timelines", title="Code-phase timelines", figures=timelines,
            picker=[(figure.data[0]["env"], title_of(figure.data[0]["env"])) for figure in timelines],
        ),
        section("structure", "Structure", title="Realised structure", figures=shown_figures("structure"),
                 tables=shown_tables("structure")),
        section(
            "cost", "Cost and audit", figures=shown_figures("tokens", "wall_time"),
            tables=shown_tables("tokens", "audit", "signals", "simulator_flags"),
        ),
        section(
            "feedback", "Feedback use",
            texts=["Each run has a page: what its agent read and said before every submit, what it changed, and what came of it, with "
                   "all checkpoints and their differences."],
            tables=shown_tables("runs") if trace_links else [],
            links=[(f"All submits in one table ({label})", f"tables/feedback_use.{suffix}") for label, suffix in FORMS]
            if trace_links
            else [],
        ),
        section(
            "replays", "Replays",
            texts=["Videos of the selected checkpoints' episodes, agents side by side."] if replay_links else
            ["None of these runs has recorded episodes of its selected checkpoint."],
            links=[(title_of(env), href) for env, href in replay_links.items()],
        ),
        section("setup", "Setup", tables=shown_tables("agents", "environments", "not_told")),
        section(
            "left-out", "Left out",
            tables=shown_tables("left_out") if study.left_out else [],
            texts=[] if study.left_out else ["Nothing: every run folder that was found is in this report."],
        ),
    ]  # fmt: skip
    if n_envs < _RANKS_FROM:
        first = [section("returns", "Returns", title="Held-out returns", tables=returns)]
        first += [each for each in sections if each["id"] == "evolution"]
        sections = first + [each for each in sections if each["id"] != "evolution"]
    kept = [
        s for s in sections if s["figures"] or s["tables"] or s["links"] or s["id"] in ("replays", "left-out")
    ]
    return page(
        "index",
        title=title,
        lead="Agents evolve an executable policy under a budget of train episodes; the checkpoint that hidden validation selects is "
        "scored on hidden held-out cases.",
        facts=[
            *(
                (noun if n != 1 else noun.removesuffix("s"), n)
                for noun, n in (
                    ("agents", len(study.entries)),
                    ("environments", n_envs),
                    ("runs", len(study.runs)),
                    *([("of these from a submit", n_started)] if n_started else []),
                    ("submits", sum(len(run.submits) for run in study.runs)),
                )
            ),
            ("left out", len(study.left_out)),
        ],
        looks=looks,
        notices=_notices(study),
        sections=kept,
        footer="Scores rank held-out means within each environment; everything below the leaderboard is a diagnostic and no part of "
        "the score. Made by evopolicy report.",
        data="report.json",
    )  # fmt: skip


_ISOLATION_NOTICES = {
    "unknown": "do not tell whether hidden episodes and agents shared a kernel: they are from before it was recorded.",
    "shared": "were played while hidden episodes and agents could share a kernel (--hidden-isolation off).",
    "waived": "had agents whose place the operator vouched for (--agent-host elsewhere).",
}


def _notices(study: Study) -> list[dict[str, Any]]:
    n, audit = len(study.runs), study.audit
    found = [notice(study.post_hoc)] if study.post_hoc else []
    if study.mixtures:
        title = "These runs are no fair comparison: they were mixed on purpose, and differ in"
        found.append(notice(title, map(str, study.mixtures)))
    counts = (
        (
            sum(not one.secret_splits for one in audit),
            "played public splits, of case files or a public seed: agents and models may know the hidden cases.",
        ),
        (
            sum(bool(run.simulator_flags) for run in study.runs),
            "have code that looks like a simulator, which their rules forbid: a signal to read, never a verdict.",
        ),
        (
            sum(bool(run.signals) for run in study.runs),
            "have signals in their log or code that deserve a look; none is a verdict.",
        ),
        (
            sum(run.simulation_allowed for run in study.runs),
            "let their agent simulate, or are from before there was a rule against it.",
        ),
        (sum(one.jail == "none" for one in audit), "had no jail around their agent."),
        *(
            (sum(one.hidden_isolation == isolation for one in audit), text)
            for isolation, text in _ISOLATION_NOTICES.items()
        ),
        (
            sum(one.hidden_cases == "per_run" for one in audit),
            (
                "had hidden cases of their own: no two scores are on the same cases, so differences between runs cannot"
                " be paired by case."
            ),
        ),
    )
    return found + [notice(f"{count} of {n} runs {text}") for count, text in counts if count]


def table_view(table: Table) -> dict[str, Any]:
    """The table for a page, without columns that have no value in any row."""
    columns = [
        c for c in table.columns if not table.rows or any(row.get(c.key) is not None for row in table.rows)
    ]
    return {
        "id": table.name.replace("_", "-") + "-table",
        "title": table.title,
        "caption": table.caption,
        "files": [(label, f"tables/{table.name}.{suffix}") for label, suffix in FORMS],
        "filter": len(table.rows) >= _FILTER_FROM,
        "folded": False,
        "columns": [
            {
                "title": escape(visible(column.title))
                .replace(" /", Markup("&nbsp;/"))
                .replace("-", "\u2011"),
                "numeric": column.kind != "text",
                "note": column.note,
            }
            for column in columns
        ],
        "rows": [
            [_cell(table, number, column, row.get(column.key)) for column in columns]
            for number, row in enumerate(table.rows)
        ],
    }


def _cell(table: Table, number: int, column: Column, value: Any) -> dict[str, Any]:
    numeric = column.kind != "text"
    mark = table.marks.get((number, column.key), 0)
    classes = (["n"] if numeric else []) + [["first", "second"][mark - 1]] * bool(mark)
    if value is None and not numeric:
        classes.append("none")
    if not numeric and len(str(value)) > _LONG:
        classes.append("long")
    return {
        "text": shown(value, column),
        "value": ("" if value is None else value) if numeric else None,
        "cls": " ".join(classes),
        "href": table.links.get(number) if column.key == "run" else None,
        "entry": value if column.key == "entry" else None,
    }


def trace_page(
    trace: Trace,
    *,
    look: Look | None,
    image_links: Mapping[int, Sequence[tuple[str, str]]],
    videos: Mapping[int, str],
    beside: Sequence[tuple[str, Look | None, str]] = (),
) -> str:
    """One run's page. By submit index, `image_links` has (name, path relative to the page) of its copied images, and
    `videos` the path of its copied feedback video. `beside` lists (agent, look, page) of other agents on the same
    environment."""
    run = trace.run
    outcome = run.record.outcome
    transitions = [row.transition for row in trace.rows if row.transition is not None]
    checkpoints = _checkpoints(trace)
    anchors = {view["label"]: view["anchor"] for view in checkpoints}
    starts = [row.submit.started_at for row in trace.rows]
    has_evidence = any(row.evidence is not None for row in trace.rows)
    note = "" if has_evidence else "This run's log does not tell what was read or said before which submit."
    facts = [
        (
            "held-out mean" if run.rescore is None else f"post hoc mean, {run.rescore.name}",
            "–" if run.score is None else f"{run.score:.3f}",
        ),
        ("selected", "–" if outcome.best_submit_index is None else f"s{outcome.best_submit_index:03d}"),
        ("submits", len(run.submits)),
        ("episodes used", f"{run.submits[-1].consumed if run.submits else 0} of {run.budget}"),
        ("rejected requests", "–" if run.is_published else len(run.record.rejected_submits)),
    ]
    phases = Row(transitions=transitions, budget=run.budget, submits=run.submits)
    label = f"Code phases of {len(run.submits)} submits over {run.budget} episodes"
    svg = inline_svg(timeline_svg([phases]), "phases", label) if transitions else ""
    closed = in_words(outcome.closed_reason)
    return page(
        "trace",
        title=f"{run.entry} on {title_of(run.env)}, {run.record.exp_id}",
        entry=run.entry,
        env_title=title_of(run.env),
        lead=f"Run {run.record.exp_id}, repeat {run.record.repeat}, harness {run.harness}, policy scope "
        f"{run.record.experiment_dimensions.policy_scope}" + (f", ended by: {closed}." if closed else "."),
        look=look,
        beside=beside,
        facts=facts,
        budget=run.budget,
        timeline=Markup(svg),
        log_note=note,
        rows=[
            _trace_row(row, trace, anchors, image_links.get(row.submit.index, ()), videos.get(row.submit.index), words)
            for row, words in zip(trace.rows, model_calls.before(run.path, starts), strict=True)
        ],
        unplaced=trace.unplaced,
        simulation_allowed=run.simulation_allowed,
        flags=[_evidence(each) for each in run.simulator_flags],
        signals=[_evidence(each) for each in run.signals if each not in run.simulator_flags],
        checkpoints=checkpoints,
    )  # fmt: skip


def _evidence(each: Signal) -> dict[str, Any]:
    return {
        "title": TITLES[each.kind],
        "place": each.place,
        "submits": submits_text(each.submits),
        "reason": each.reason,
        "quote": each.quote,
    }


def failed_page(run: Run, reason: str) -> str:
    """Replaces a run's page that could not be made."""
    return page("failed", title=f"{run.entry} on {title_of(run.env)}, {run.record.exp_id}", reason=reason)


def _trace_row(
    row: TraceRow,
    trace: Trace,
    anchors: Mapping[str, str],
    images: Sequence[tuple[str, str]],
    video: str | None,
    calls: str,
) -> dict[str, Any]:
    submit, transition, evidence = row.submit, row.transition, row.evidence
    messages = list(evidence.messages) if evidence is not None else []
    return {
        "label": submit.label,
        "anchor": anchors.get(submit.label),
        "selected": submit.index == trace.run.record.outcome.best_submit_index,
        "consumed_before": submit.consumed_before,
        "consumed": submit.consumed,
        "n_episodes": submit.n_episodes,
        "read": list(evidence.read[:12]) + (["…"] if len(evidence.read) > 12 else [])
        if evidence is not None
        else [],
        "quote": messages[-1] if messages else "",
        "more": messages[:-1][-20:],
        "images": [{"name": name, "href": href} for name, href in images],
        "video": video,
        "edit": transition.edit if transition is not None else "",
        "change": _change(row),
        "calls": calls,
        "workspace": changes(trace.run.path, submit.index),
        "outcome": _outcome(submit, row, trace),
        "hit": transition is not None and transition.hit,
    }


def _change(row: TraceRow) -> str:
    submit, transition = row.submit, row.transition
    if transition is not None and transition.edit == "rollback":
        return f"to the topology of s{transition.back_to:03d}, {submit.changed_lines} lines changed"
    if transition is not None and transition.edit == "retest":
        return "same bytes"
    if transition is not None and transition.edit == "data":
        return "other files of system/ changed, not the source bundle"
    if submit.changed_lines is None:
        return ""
    return f"{submit.changed_lines} lines changed"


def _outcome(submit: Submit, row: TraceRow, trace: Trace) -> str:
    if submit.status != "ok":
        return f"{in_words(submit.status)}: no working policy"
    parts: list[str] = []
    before = next((r.submit for r in trace.rows if r.transition and row.transition
                   and r.submit.index == row.transition.previous), None)  # fmt: skip
    if submit.mean_return is not None:
        change = ""
        if before is not None and before.mean_return is not None:
            change = f" ({submit.mean_return - before.mean_return:+.3g})"
        parts.append(f"visible mean {submit.mean_return:.4g}{change}")
    if submit.val_mean is not None:
        change = (
            f" ({submit.val_mean - before.val_mean:+.3g})"
            if before is not None and before.val_mean is not None
            else ""
        )
        parts.append(f"validation mean {submit.val_mean:.4g}{change}")
    if submit.n_failed_episodes:
        parts.append(f"policy failed in {submit.n_failed_episodes} of {submit.n_episodes} episodes")
    return "; ".join(parts)


def _checkpoints(trace: Trace) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    previous: dict[str, str] | None = None
    seen: dict[str, str] = {}
    for row in trace.rows:
        text = sources(trace.run, row.submit)
        if not text:
            continue
        key = repr(sorted(text.items()))
        same_as = seen.setdefault(key, row.submit.label)
        is_new = same_as == row.submit.label
        files_view = (
            [{"path": p, "text": t, "n_lines": len(t.splitlines())} for p, t in text.items()]
            if is_new
            else []
        )
        diffs = [] if previous is None else diff(previous, text)
        out.append(
            {
                "label": row.submit.label,
                "anchor": f"{row.submit.label}-source",
                "edit": row.transition.edit if row.transition is not None else "",
                "same_as": "" if is_new else same_as,
                "diffs": [
                    {"path": d.path, "cut": d.cut, "lines": [(_diff_class(line), line) for line in d.lines]}
                    for d in diffs
                ],
                "files": files_view,
            }
        )
        previous = text
    return out


def _diff_class(line: str) -> str:
    return {"+": "ins", "-": "del", "@": "hunk"}.get(line[:1], "")


def replays_page(env: str, episodes: Sequence[PlayedEpisode], looks: Mapping[str, Look]) -> str:
    """One environment's recordings: one group per case, with one card per run."""
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for played in sorted(
        episodes, key=lambda p: (p.split, p.episode, p.run.entry.casefold(), p.run.record.repeat)
    ):
        facts = [f"s{played.submit_index:03d}"]
        if played.episode_return is not None:
            facts.append(f"return {played.episode_return:.4g}")
        if played.length is not None:
            facts.append(f"{played.length} steps")
        groups.setdefault((played.split, played.episode), []).append(
            {
                "entry": played.run.entry,
                "run": played.run.record.exp_id,
                "video": played.video,
                "strip": played.strip,
                "text": ", ".join(facts),
            }
        )
    return page(
        "replays",
        title=f"Replays: {title_of(env)}",
        env_title=title_of(env),
        looks=looks,
        groups=[{"title": f"{'Held-out' if split == 'heldout' else split.capitalize()} case {n}", "cards": cards} for (split, n), cards in groups.items()],
    )  # fmt: skip


def default_title(study: Study) -> str:
    """`Core16 (3 of 16), Toy: policy evolution report`."""
    return ", ".join(suite.title for suite in study.suites) + ": policy evolution report"
