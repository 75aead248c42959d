"""One run's code-phase timeline as a small hand-written SVG: a thousand pages should not need a drawing library."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

from evopolicy_results.behaviour.edits import Transition, events_of, phases
from evopolicy_results.reading.records import Submit
from evopolicy_results.studies.palette import EDIT_COLOURS

_WIDTH, _LEFT, _RIGHT = 900.0, 14.0, 20.0
_BAND_TOP, _BAND_HEIGHT, _MARKS, _AXIS, _HEIGHT = 16.0, 30.0, 62.0, 78.0, 112.0


def small_timeline(
    transitions: Sequence[Transition], submits: Sequence[Submit], budget: int, prefix: str
) -> str:
    """Bands, a mark and label for every submit, and the budget axis. `prefix` makes its ids unique."""
    last = max([budget, *(submit.consumed for submit in submits), 1])
    scale = (_WIDTH - _LEFT - _RIGHT) / last

    def x(consumed: float) -> float:
        return _LEFT + consumed * scale

    hatch = escape(f"{prefix}hatch", quote=True)
    label = f"Code phases of {len(submits)} submits over {budget} episodes"
    out = [
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" style="font: 12px system-ui, sans-serif">',
        f'<defs><pattern id="{hatch}" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
        f'<rect width="6" height="6" fill="{EDIT_COLOURS["parametric"]}"/><path d="M0 0v6" stroke="#fff" stroke-width="2" opacity=".6"/>'
        "</pattern></defs>",
    ]
    for start, end, edit in phases(transitions):
        fill = f"url(#{hatch})" if edit == "parametric" else EDIT_COLOURS[edit]
        out.append(
            f'<rect x="{x(start):.1f}" y="{_BAND_TOP}" width="{max(1.0, (end - start) * scale):.1f}" '
            f'height="{_BAND_HEIGHT}" fill="{fill}" opacity=".7"><title>{edit}: {start} to {end} episodes</title></rect>'
        )
    out.append(_axis(last, x))
    by_index = {transition.index: transition for transition in transitions}
    previous = -100.0
    for submit in submits:
        at = x(submit.consumed)
        out.append(_mark(by_index.get(submit.index), at, submit))
        if at - previous > 34.0:
            anchor = "end" if at > _WIDTH - 30 else "middle"
            out.append(
                f'<text x="{at:.1f}" y="11" text-anchor="{anchor}" fill="var(--muted)" font-size="10">{submit.label}</text>'
            )
            previous = at
    out.append("</svg>")
    return "".join(out)


def _axis(last: int, x: Callable[[float], float]) -> str:
    step = next((s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if last / s <= 8), max(1, last // 8))
    ticks = "".join(
        f'<path d="M{x(tick):.1f} {_AXIS}v4" stroke="var(--muted)"/>'
        f'<text x="{x(tick):.1f}" y="{_AXIS + 16}" text-anchor="middle" fill="var(--ink)" font-size="11">{tick}</text>'
        for tick in range(0, last + 1, step)
    )
    title = (
        f'<text x="{_WIDTH / 2}" y="{_HEIGHT - 5}" text-anchor="middle" fill="var(--ink)" font-size="11">'
        "Train episodes consumed</text>"
    )
    return f'<path d="M{_LEFT} {_AXIS}H{_WIDTH - _RIGHT}" stroke="var(--muted)" fill="none"/>{ticks}{title}'


def _mark(transition: Transition | None, at: float, submit: Submit) -> str:
    title = f"<title>{submit.label}: {submit.status}</title>"
    if transition is None:
        return f'<text x="{at:.1f}" y="{_MARKS + 4}" text-anchor="middle" fill="var(--ink)" font-weight="700">!{title}</text>'
    title = f"<title>{submit.label}: {transition.edit}, validation mean {transition.val_mean:.4g}</title>"
    parts: list[str] = []
    for kind in events_of(transition):
        if kind == "hit":
            parts.append(
                f'<path transform="translate({at:.1f} {_MARKS})" fill="var(--ink)" '
                f'd="M0-7 1.7-2.2 6.7-2.2 2.7.9 4.1 5.7 0 2.8-4.1 5.7-2.7.9-6.7-2.2-1.7-2.2z">{title}</path>'
            )
        elif kind == "miss":
            parts.append(
                f'<circle cx="{at:.1f}" cy="{_MARKS}" r="4" fill="none" stroke="var(--ink)" stroke-width="1.4">{title}</circle>'
            )
        else:
            shape = "M-5-4h10L0 5z" if kind == "rollback" else "M-4-4 4 4M4-4-4 4"
            parts.append(
                f'<path transform="translate({at:.1f} {_BAND_TOP + _BAND_HEIGHT / 2})" d="{shape}" fill="none" '
                f'stroke="#15181d" stroke-width="1.8">{title}</path>'
            )
    return "".join(parts)
