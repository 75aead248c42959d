"""Code-phase timelines as hand-written SVG: a report has one for each environment and run, too many for a drawing
library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import msgspec

from evopolicy_common.catalogue import folder_name
from evopolicy_common.terminal import one_line
from evopolicy_results.behaviour.edits import Transition, classify, events_of, phases
from evopolicy_results.figures.plot import INK, MUTED, Plot
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import PastRun, PastSubmit, rows
from evopolicy_results.studies.palette import EDIT_COLOURS, Look

MAX_ROWS = 24
"""Maximum number of runs in one environment's figure; every run's own page has its own timeline."""
_MAX_LABEL = 32
_WIDTH, _ROW, _BAND, _AXIS = 900.0, 48.0, 24.0, 38.0
_LETTER = 6.6
"""Assumed mean width of a letter of 11 px."""
_BANDS = {
    "first": "first policy",
    "synthesis": "synthesis edits",
    "parametric": "parametric edits",
    "data": "data files only",
}
_MARKS = {
    "hit": ("raises the validation best", f'<path id="hit" fill="{INK}" d="M0-7 1.7-2.2 6.7-2.2 2.7.9 4.1 5.7 0 2.8-4.1 5.7-2.7.9-6.7-2.2-1.7-2.2z"/>'),
    "miss": ("does not", f'<circle id="miss" r="4" fill="none" stroke="{INK}" stroke-width="1.4"/>'),
    "rollback": ("rollback", f'<path id="rollback" d="M-5-4h10L0 5z" fill="{INK}"/>'),
    "retest": ("retest", f'<path id="retest" d="M-4-4 4 4M4-4-4 4" stroke="{INK}" stroke-width="1.8"/>'),
    "bad": ("not ok", f'<path id="bad" d="M0-6V2M0 4V6" stroke="{INK}" stroke-width="2.4"/>'),
}  # fmt: skip
"""By mark: its meaning and its shape."""
_HATCH = (
    '<pattern id="parametric" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
    f'<rect width="6" height="6" fill="{EDIT_COLOURS["parametric"]}"/><path d="M0 0v6" stroke="#fff" stroke-width="2" opacity=".6"/>'
    "</pattern>"
)


class RunBand(msgspec.Struct, frozen=True, kw_only=True):
    """One run's band and marks."""

    transitions: Sequence[Transition]
    budget: int
    label: str = ""
    look: Look | None = None
    submits: Sequence[PastSubmit] = ()
    """All submits: they are named above the band, and those without a score are marked too."""


def timeline_of(env: str, runs: Iterable[PastRun], looks: Mapping[str, Look]) -> Plot | None:
    """One environment's runs, one row each."""
    drawn = [(run, transitions) for run in runs if (transitions := classify(run.submits))]
    if not drawn:
        return None
    cut = sorted(drawn, key=lambda one: (one[0].record.repeat, one[0].entry.casefold()))[:MAX_ROWS]
    cut.sort(key=lambda one: (one[0].entry.casefold(), one[0].record.repeat))
    dropped = len(drawn) - len(cut)
    data, lines = [], []
    for run, transitions in cut:
        entry, repeat, budget = run.entry, run.record.repeat, run.budget
        about = {"run": run.name, "entry": entry, "env": env, "repeat": repeat, "budget": budget}
        data.append({**about, "transitions": rows(transitions)})
        label = f"{entry} #{repeat}" if repeat else entry
        lines.append(RunBand(transitions=transitions, budget=budget, label=label, look=looks[entry]))
    return Plot(
        name=f"timeline_{folder_name(env)}",
        title=f"{title_of(env)} code phases",
        caption="Phases by edit type over the budget; a mark stands where its submit's episodes end. Rollbacks and retests are "
        "events within a phase. A filled star raises the best validation mean so far."
        + (f" {dropped} more runs have their timelines on their own pages." if dropped else ""),
        alt=f"Timelines of {len(cut)} runs on {title_of(env)}: bands of synthesis and parametric edits with outcome marks.",
        data=data,
        svg=timeline_svg(lines),
    )


def timeline_svg(runs: Sequence[RunBand]) -> str:
    """A legend, a row for each run, and the axis of the budget."""
    labels = [one_line(run.label)[:_MAX_LABEL] for run in runs]
    left = 14.0 + max((_LETTER * len(label) + 20.0 for label in labels if label), default=0.0)
    right = 90.0 if any(labels) else 20.0
    last = max([1, *(end for run in runs for end in (run.budget, *(s.consumed for s in run.submits)))])
    scale = (_WIDTH - left - right) / last
    height = 42.0 + _ROW * len(runs) + _AXIS
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH:g}" height="{height:g}" viewBox="0 0 {_WIDTH:g} {height:g}" '
        f'font-family="\'DejaVu Sans\', sans-serif" font-size="11" fill="{INK}"><defs>{_HATCH}'
        + "".join(shape for _, shape in _MARKS.values())
        + "</defs>",
        _legend(runs),
    ]
    for place, (run, label) in enumerate(zip(runs, labels, strict=True)):
        top = 42.0 + _ROW * place
        if run.look is not None:
            out.append(
                f'<path transform="translate({left - 22:.1f} {top + 6})scale(.75)" fill="{run.look.colour}" d="{run.look.path}"/>'
                f'<text x="{left - 28:.1f}" y="{top + 16}" text-anchor="end">{escape(label)}</text>'
                f'<text x="{_WIDTH - right + 12:.1f}" y="{top + 16}">best {run.transitions[-1].best:.4g}</text>'
            )
        out += _row(run, top, left, scale)
    bottom = 42.0 + _ROW * len(runs)
    out.append(f'<path d="M{left:.1f} {bottom}H{_WIDTH - right}" stroke="{MUTED}"/>')
    step = next((s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if last / s <= 8), max(1, last // 8))
    out += [
        f'<path d="M{left + tick * scale:.1f} {bottom}v4" stroke="{MUTED}"/>'
        f'<text x="{left + tick * scale:.1f}" y="{bottom + 16}" text-anchor="middle">{tick}</text>'
        for tick in range(0, last + 1, step)
    ]
    middle = (left + _WIDTH - right) / 2
    out.append(
        f'<text x="{middle:.1f}" y="{height - 5}" text-anchor="middle">Train episodes consumed</text></svg>'
    )
    return "".join(out)


def _row(run: RunBand, top: float, left: float, scale: float) -> list[str]:
    out: list[str] = []
    for start, end, edit in phases(run.transitions):
        fill = "url(#parametric)" if edit == "parametric" else EDIT_COLOURS[edit]
        out.append(
            f'<rect x="{left + start * scale:.1f}" y="{top}" width="{max(1.0, (end - start) * scale):.1f}" '
            f'height="{_BAND:g}" fill="{fill}" opacity=".7"/>'
        )
    for transition in run.transitions:
        title = f"<title>{transition.edit}, validation mean {transition.val_mean:.4g}</title>"
        out += [_mark(kind, left + transition.consumed * scale, top, title) for kind in events_of(transition)]
    scored = {transition.index for transition in run.transitions}
    previous = -100.0
    for submit in run.submits:
        at = left + submit.consumed * scale
        if submit.index not in scored:
            out.append(_mark("bad", at, top, f"<title>{submit.label}: {submit.status}</title>"))
        if at - previous > 34.0:
            anchor = "end" if at > _WIDTH - 30 else "middle"
            out.append(
                f'<text x="{at:.1f}" y="{top - 4}" text-anchor="{anchor}" fill="{MUTED}" font-size="10">{submit.label}</text>'
            )
            previous = at
    return out


def _mark(kind: str, x: float, top: float, title: str) -> str:
    y = top + (_BAND / 2 if kind in ("rollback", "retest") else _BAND + 11)
    return f'<use href="#{kind}" x="{x:.1f}" y="{y:g}">{title}</use>'


def _legend(runs: Sequence[RunBand]) -> str:
    edits = {edit for run in runs for _, _, edit in phases(run.transitions)}
    kinds = {kind for run in runs for transition in run.transitions for kind in events_of(transition)}
    if any(len(run.submits) > len(run.transitions) for run in runs):
        kinds.add("bad")
    items = [
        (f'<rect x="-8" y="-5" width="16" height="10" opacity=".7" fill="{"url(#parametric)" if edit == "parametric" else EDIT_COLOURS[edit]}"/>', text)
        for edit, text in _BANDS.items() if edit in edits
    ] + [(f'<use href="#{kind}"/>', text) for kind, (text, _) in _MARKS.items() if kind in kinds]  # fmt: skip
    out, x = [], 22.0
    for shape, text in items:
        out.append(f'<g transform="translate({x:.1f} 10)">{shape}<text x="14" y="4">{text}</text></g>')
        x += 28.0 + 5.6 * len(text)
    return "".join(out)
