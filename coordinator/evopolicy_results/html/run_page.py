"""The page of one run, in a report and in the live view: a row for each submit, with what its agent read and said
before it, what it changed, and what came of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
from markupsafe import Markup

from evopolicy_common.records import model_calls
from evopolicy_common.records.policies.trees import changes
from evopolicy_results.behaviour.trace import Trace, TraceRow
from evopolicy_results.figures.line_chart import Line, chart
from evopolicy_results.figures.plot import inline_svg
from evopolicy_results.figures.timelines import Row, timeline_svg
from evopolicy_results.html import View, part
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import Submit
from evopolicy_results.studies.palette import Look

MAX_SUBMITS = 200
"""Submits that a page of the live view lists, the newest."""


class SubmitRow(msgspec.Struct, frozen=True, kw_only=True):
    traced: TraceRow
    is_best: bool
    """Whether no other submit has a higher mean train return; one submit at most."""
    is_selected: bool
    outcome: str
    """Hidden results, in words; empty where they may not be shown."""
    change: str = ""
    """What changed, in words."""
    href: str = ""
    """The submit's code."""
    images: Sequence[tuple[str, str]] = ()
    """Names and addresses."""
    video: str = ""


def submit_rows(
    traced: Sequence[TraceRow],
    *,
    folder: Path | None = None,
    selected: int | None = None,
    may_show: bool = False,
    href: Callable[[Submit], str],
    images: Mapping[int, Sequence[tuple[str, str]]] | None = None,
    videos: Mapping[int, str] | None = None,
) -> list[SubmitRow]:
    """The rows in order. `folder`: of a finished run; `may_show`: whether its hidden results may be shown; `href`: the
    address of a submit's code, empty where there is none."""
    submits = {row.submit.index: row.submit for row in traced}
    means = {index: one.mean_return for index, one in submits.items() if one.mean_return is not None}
    best = max(means, key=lambda index: (means[index], -index), default=None)
    starts = [submit.started_at for submit in submits.values()]
    calls = [""] * len(submits) if folder is None else model_calls.before(folder, starts)
    rows: list[SubmitRow] = []
    for row, words in zip(traced, calls, strict=True):
        index = row.submit.index
        other = "" if folder is None else changes(folder, index)
        texts = [_change(row), f"workspace: {other}" if other else "", words]
        rows.append(
            SubmitRow(
                traced=row,
                is_best=index == best,
                is_selected=may_show and index == selected,
                outcome=_outcome(row, submits) if may_show else "",
                change="; ".join(filter(None, texts)),
                href=href(row.submit),
                images=(images or {}).get(index, ()),
                video=(videos or {}).get(index, ""),
            )
        )
    return rows


def _change(row: TraceRow) -> str:
    lines = row.submit.changed_lines
    changed = "" if lines is None else f"{lines} line{'' if lines == 1 else 's'} changed"
    if row.transition is not None and row.edit == "rollback":
        return f"to the topology of s{row.transition.back_to:03d}, {changed}"
    texts = {"retest": "same bytes", "data": "other files of system/ than the source bundle"}
    return texts.get(row.edit, changed)


def _outcome(row: TraceRow, by_index: Mapping[int, Submit]) -> str:
    value, transition = row.submit.val_mean, row.transition
    if value is None:
        return ""
    before = (
        None if transition is None or transition.previous is None else by_index[transition.previous].val_mean
    )
    change = "" if before is None else f" ({value - before:+.3g})"
    best = ", the highest so far" if transition is not None and transition.hit else ""
    return f"validation mean {value:.4g}{change}{best}"


def run_view(
    rows: Sequence[SubmitRow],
    *,
    entry: str,
    env: str,
    look: Look | None,
    facts: Iterable[tuple[str, object]],
    notices: Sequence[Mapping[str, object]] = (),
    budget: int = 0,
    reference: tuple[str, float] | None = None,
    is_finished: bool = True,
    trace: Trace | None = None,
    lists: Sequence[str] = (),
) -> View:
    """The parts that the page has in a report and in the live view. `lists`: of further parts."""
    view = View("submit-rows", *lists)
    view.parts |= {
        "look": part("identity", entry=entry, look=look, env_title=title_of(env)),
        "facts": part("facts", facts=facts),
        "notices": part("notices", notices=notices),
        "curve": part(
            "figure",
            ident="curve",
            svg=Markup(_curve(rows, budget, reference, "" if look is None else look.colour)),
            empty="No submit was ok." if is_finished else "No submit has a verdict yet.",
            title="Train returns over budget",
            caption="Mean train return of every ok submit, and the best so far.",
        ),
    }
    transitions = (
        [] if trace is None else [row.transition for row in trace.rows if row.transition is not None]
    )
    if trace is not None and transitions:
        submits, budget = trace.run.submits, trace.run.budget
        phases = Row(transitions=transitions, budget=budget, submits=submits)
        label = f"Code phases of {len(submits)} submits over {budget} episodes"
        view.parts["phases"] = part(
            "figure",
            ident="phases",
            svg=Markup(inline_svg(timeline_svg([phases]), "phases", label)),
            empty="",
            title="Code phases",
            caption=f"Edit types over the {budget} train episodes. A mark stands where its submit's episodes end.",
        )
    has_evidence = any(row.traced.evidence.read or row.traced.evidence.messages for row in rows)
    view.parts["submits-head"] = part("submits_head", has_evidence=has_evidence)
    for row in rows[::-1][:MAX_SUBMITS] if not is_finished else rows:
        ident = f"submit-{row.traced.submit.index}"
        view.row("submit-rows", ident, part("submit_row", ident=ident, row=row, has_evidence=has_evidence))
    return view


def _curve(rows: Sequence[SubmitRow], budget: int, reference: tuple[str, float] | None, colour: str) -> str:
    submits = [row.traced.submit for row in rows]
    points = [(float(one.consumed), one.mean_return) for one in submits if one.mean_return is not None]
    best = itertools.accumulate((mean for _, mean in points), max)
    rising = [(at, mean) for (at, _), mean in zip(points, best, strict=True)]
    lines = [
        Line("mean train return", points, dots=True, colour=colour),
        Line("best so far", rising, steps=True, colour=colour),
    ]
    return chart(
        "Train returns over budget",
        "train episodes used",
        lines,
        height=240.0,
        x_max=float(budget),
        reference=reference,
    )
