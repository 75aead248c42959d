"""The page of one run, in a report and in the live view: a row for each submit, with what its agent read and said
before it, what it changed, and what came of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence

from markupsafe import Markup

from evopolicy_results.behaviour.edits import Transition
from evopolicy_results.behaviour.trace import Trace
from evopolicy_results.figures.line_chart import ChartLine, chart
from evopolicy_results.figures.plot import inline_svg
from evopolicy_results.figures.timelines import RunBand, timeline_svg
from evopolicy_results.html import Notice, PageView, part
from evopolicy_results.reading.agent_log import Evidence
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import PastSubmit
from evopolicy_results.studies.palette import Look

MAX_SUBMITS = 200
"""Submits that a page of the live view lists, the newest."""


def _change(submit: PastSubmit, transition: Transition | None) -> str:
    lines = submit.changed_lines
    changed = "" if lines is None else f"{lines} line{'' if lines == 1 else 's'} changed"
    if transition is not None and transition.edit == "rollback":
        return f"to the topology of s{transition.back_to:03d}, {changed}"
    texts = {"retest": "same bytes", "data": "other files of system/ than the source bundle"}
    return texts.get("" if transition is None else transition.edit, changed)


def _outcome(submit: PastSubmit, transition: Transition | None, by_index: Mapping[int, PastSubmit]) -> str:
    """Its hidden results in words; empty without any."""
    value = submit.val_mean
    if value is None:
        return ""
    before = (
        None if transition is None or transition.previous is None else by_index[transition.previous].val_mean
    )
    change = "" if before is None else f" ({value - before:+.3g})"
    best = ", the highest so far" if transition is not None and transition.hit else ""
    return f"validation mean {value:.4g}{change}{best}"


def run_view(
    submits: Sequence[PastSubmit],
    trace: Trace | None = None,
    *,
    may_show: bool = False,
    href: Callable[[PastSubmit], str],
    images: Mapping[int, Sequence[tuple[str, str]]] | None = None,
    videos: Mapping[int, str] | None = None,
    entry: str,
    env: str,
    look: Look | None,
    facts: Iterable[tuple[str, object]],
    notices: Sequence[Notice] = (),
    budget: int = 0,
    reference: tuple[str, float] | None = None,
    is_finished: bool = True,
    lists: Sequence[str] = (),
) -> PageView:
    """The parts that the page has in a report and in the live view.

    `trace`: of a run that a report can read; `may_show`: whether its hidden results may be shown. `href`: the address
    of a submit's code, empty where there is none; `images` (names and addresses) and `videos`: by submit index.
    `lists`: of further parts.
    """
    transitions = {} if trace is None else trace.transitions
    view = PageView("submit-rows", *lists)
    view.parts |= {
        "look": part("identity", entry=entry, look=look, env_title=title_of(env)),
        "facts": part("facts", facts=facts),
        "notices": part("notices", notices=notices),
        "curve": part(
            "figure",
            ident="curve",
            svg=Markup(_curve(submits, budget, reference, "" if look is None else look.colour)),
            empty="No submit was ok." if is_finished else "No submit has a verdict yet.",
            title="Train returns over budget",
            caption="Mean train return of every ok submit, and the best so far.",
        ),
    }
    if may_show and transitions:
        phases = RunBand(transitions=list(transitions.values()), budget=budget, submits=submits)
        label = f"Code phases of {len(submits)} submits over {budget} episodes"
        view.parts["phases"] = part(
            "figure",
            ident="phases",
            svg=Markup(inline_svg(timeline_svg([phases]), "phases", label)),
            empty="",
            title="Code phases",
            caption=f"Edit types over the {budget} train episodes. A mark stands where its submit's episodes end.",
        )
    evidence = {} if trace is None else trace.evidence
    has_evidence = any(each.read or each.messages for each in evidence.values())
    view.parts["submits-head"] = part("submits_head", has_evidence=has_evidence)
    by_index = {one.index: one for one in submits}
    means = {one.index: one.mean_return for one in submits if one.mean_return is not None}
    best = max(means, key=lambda index: (means[index], -index), default=None)
    selected = trace.run.record.outcome.best_submit_index if trace is not None and may_show else None
    for one in submits[::-1][:MAX_SUBMITS] if not is_finished else submits:
        ident, transition = f"submit-{one.index}", transitions.get(one.index)
        change = [_change(one, transition), "" if trace is None else trace.work[one.index]]
        row = part(
            "submit_row",
            ident=ident,
            submit=one,
            edit="" if transition is None else transition.edit,
            change="; ".join(filter(None, change)),
            outcome=_outcome(one, transition, by_index) if may_show else "",
            is_best=one.index == best,
            is_selected=one.index == selected,
            href=href(one),
            clip=(videos or {}).get(one.index, ""),
            evidence=evidence.get(one.index, Evidence()) if has_evidence else None,
            images=(images or {}).get(one.index, ()),
        )
        view.row("submit-rows", ident, row)
    return view


def _curve(
    submits: Sequence[PastSubmit], budget: int, reference: tuple[str, float] | None, colour: str
) -> str:
    points = [(float(one.consumed), one.mean_return) for one in submits if one.mean_return is not None]
    best = itertools.accumulate((mean for _, mean in points), max)
    rising = [(at, mean) for (at, _), mean in zip(points, best, strict=True)]
    lines = [
        ChartLine("mean train return", points, dots=True, colour=colour),
        ChartLine("best so far", rising, steps=True, colour=colour),
    ]
    return chart(
        "Train returns over budget",
        "train episodes used",
        lines,
        height=240.0,
        x_max=float(budget),
        reference=reference,
    )
