"""The pages of one run, of one of its submits, and of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from markupsafe import Markup

from evopolicy_common.messages.status import RetriedJobs, StatusReply
from evopolicy_common.records.model_calls import before
from evopolicy_common.records.policies.trees import changes
from evopolicy_common.records.summary import utc_text
from evopolicy_common.terminal import duration, number
from evopolicy_coordinator.web.content.charts import Line, chart
from evopolicy_coordinator.web.content.feeds import View
from evopolicy_coordinator.web.content.rendering import part, short, state_words
from evopolicy_coordinator.web.content.run_detail import (
    MAX_WORDS,
    CodeFile,
    Detail,
    EpisodePlot,
    Happened,
    Series,
)
from evopolicy_coordinator.web.content.run_folders import Reader, RunFacts, Runs, Submit
from evopolicy_coordinator.web.content.tables import Words, ident
from evopolicy_results.behaviour.trace import diff
from evopolicy_results.html import notice
from evopolicy_results.reading.environments import title_of
from evopolicy_results.studies.palette import looks

MAX_SUBMITS = 200
"""Submits that a run's page lists, the newest."""
MAX_EPISODES = 256


def run_view(
    run: RunFacts,
    runs: Runs,
    reader: Reader,
    words: Words,
    *,
    acting: bool,
    status: StatusReply | None,
    retries: Sequence[RetriedJobs] = (),
) -> View:
    """One run: curve, submits, words, events. `retries`: the jobs of it that the cluster has played again."""
    may_show = runs.may_show(run)
    look = looks([run.entry], None)[run.entry]
    submits = [] if run.path is None else reader.submits(run.path)
    detail = None if run.path is None else Detail(run.path)
    reference = ("random, held-out", run.random) if may_show and run.random is not None else None
    parts = {
        "facts": part("facts", facts=_run_facts(run, may_show)),
        "lineage": part(
            "lineage",
            run=run,
            parent=runs.of(run.start.run) if run.start else None,
            original=runs.of(run.replay_of),
        ),
        "notices": part("notices", notices=_one_run_notices(run, may_show)),
        "curve": part(
            "figure",
            ident="curve",
            svg=Markup(_curve(submits, run, reference)),
            empty="No submit was ok." if run.finished else "No submit has a verdict yet.",
            title="Train returns over budget",
            caption="Mean visible train return of every ok submit, and the best so far.",
        ),
        "actions": part("run_actions", run=run, acting=acting, classes=_classes(run, status)),
    }
    lists: dict[str, list[str]] = {"submit-rows": [], "messages": [], "events": []}
    best = float("-inf")
    rises = []
    for submit in submits:
        rises.append(submit.mean is not None and submit.mean > best)
        best = max(best, submit.mean) if rises[-1] and submit.mean is not None else best
    for submit, rise in list(zip(submits, rises, strict=True))[::-1][:MAX_SUBMITS]:
        name = f"submit-{submit.summary.submit_index}"
        lists["submit-rows"].append(name)
        shown = {"submit": submit.summary, "consumed": submit.consumed}
        parts[name] = part("submit_row", ident=name, key=run.key, best=rise, **shown)
    messages = [] if detail is None else detail.messages(words.before)
    for one in messages:
        name = f"message-{one.at}"
        lists["messages"].append(name)
        parts[name] = part("message", ident=name, one=one)
    earlier = words.link(before=messages[0].at) if messages and messages[0].at > 0 else ""
    parts["messages-more"] = part(
        "messages_more", earlier=earlier, latest=words.before is not None, n=len(messages)
    )
    events = [*([] if detail is None else detail.happened()), *map(_retried, retries)]
    for one_event in sorted(events, key=lambda each: each.at, reverse=True)[:MAX_WORDS]:
        name = ident("event", one_event.at, one_event.text)
        if name not in parts:
            lists["events"].append(name)
            parts[name] = part("event", ident=name, one=one_event)
    parts["look"] = part("identity", run=run, look=look, env_title=title_of(run.env))
    return View(parts=parts, lists=lists)


def _retried(one: RetriedJobs) -> Happened:
    jobs = "1 job" if one.jobs == 1 else f"{one.jobs} jobs"
    what = {
        "worker_lost": f"Worker {one.worker} was lost with {jobs} of this run",
        "failed": f"{jobs} failed on worker {one.worker}, through no fault of the policy",
        "overdue": f"Worker {one.worker} held {jobs} for longer than any episode may take",
        "unlisted": f"Worker {one.worker} does not know of {jobs} that it was sent",
    }.get(one.failure, f"{jobs} on worker {one.worker}: {one.failure}")
    again = "It is played again" if one.jobs == 1 else "They are played again"
    at = utc_text(one.at)[:19].replace("T", " ")
    return Happened(at=at, level="warning", text=f"{what}. {again}, at no charge.")


def _run_facts(run: RunFacts, may_show: bool) -> list[tuple[str, str]]:
    facts = [
        ("state", state_words(run.state)),
        ("episodes used", f"{run.used} of {run.budget}" if run.budget else str(run.used)),
        ("submits", str(run.n_submits)),
        ("best train return", number(run.best)),
    ]
    if may_show and run.score is not None:
        facts += [("held-out score", number(run.score)), ("random", number(run.random))]
    if run.running or run.queued:
        facts.append(("running, queued", f"{run.running}, {run.queued}"))
    if run.tokens:
        facts.append(("tokens", short(run.tokens)))
    if run.cost:
        facts.append(("cost", f"${run.cost:.2f}"))
    if run.retries:
        facts.append(("jobs played again", str(run.retries)))
    if run.finished and run.wall_s:
        facts.append(("took", duration(run.wall_s)))
    elif run.left_s is not None:
        facts.append(("time left, about", duration(run.left_s)))
    return facts


def _one_run_notices(run: RunFacts, may_show: bool) -> list[dict[str, Any]]:
    notices: list[dict[str, Any]] = []
    if run.waits_for:
        notices.append(notice(f"It waits for {run.waits_for}."))
    if run.error:
        title = f"It {state_words(run.state)}" if run.state == "failed" else "Why it ended so"
        notices.append(notice(title, [run.error]))
    if run.finished and not may_show and run.state == "completed":
        notices.append(notice("Its hidden scores are shown once no agent of a related run is alive."))
    if run.path is None:
        where = f" on {run.host}" if run.host else ""
        notices.append(
            notice(f"Its folder is not on this host{where}: only what the cluster tells is shown.")
        )
    return notices


def _curve(submits: Sequence[Submit], run: RunFacts, reference: tuple[str, float] | None) -> str:
    points, best, rising = [], float("-inf"), []
    for submit in submits:
        if submit.mean is not None:
            points.append((float(submit.consumed), submit.mean))
            best = max(best, submit.mean)
            rising.append((float(submit.consumed), best))
    lines = [Line("mean train return", points, dots=True), Line("best so far", rising, steps=True)]
    return (
        chart(
            "Train returns over budget",
            "train episodes consumed",
            lines,
            height=240.0,
            x_max=float(run.budget or 0),
            reference=reference,
        )
        if points
        else ""
    )


def _classes(run: RunFacts, status: StatusReply | None) -> list[str]:
    """Classes of workers that could play the run, but get no work of it as it is pinned to another class."""
    others = () if status is None else status.workers
    return sorted(
        {
            worker.classes[run.env]
            for worker in others
            if run.run in worker.refused and run.env in worker.classes and worker.state != "lost"
        }
    )


def submit_values(run: RunFacts, reader: Reader, index: int) -> dict[str, Any] | None:
    """The parts of one submit's page; None for an unknown submit."""
    if run.path is None:
        return None
    submits = {one.summary.submit_index: one for one in reader.submits(run.path)}
    submit = submits.get(index)
    if submit is None:
        return None
    detail, may_read = Detail(run.path), run.finished
    code = detail.code(index, checkpoints=may_read)
    previous = detail.code(index - 1, checkpoints=may_read) if index - 1 in submits else ()
    summary = detail.summary(index)
    returns, lengths = _numbers(summary.get("returns")), _numbers(summary.get("episode_lengths"))
    cases = _numbers(summary.get("env_instances"))
    failed = {int(each) for each in _numbers(summary.get("errors")) if each is not None}
    first, known = summary.get("first_global_episode"), detail.episodes(index)
    begin = first if isinstance(first, int) else known[0] if known else 0
    episodes = [
        {
            "number": begin + at,
            "kept": begin + at in known,
            "case": _at(cases, at),
            "value": _at(returns, at),
            "length": _at(lengths, at),
            "failed": at in failed,
        }
        for at in range(min(MAX_EPISODES, submit.summary.n_episodes))
    ]
    return {
        "submit": submit.summary,
        "consumed": submit.consumed,
        "previous": index - 1 if index - 1 in submits else None,
        "next": index + 1 if index + 1 in submits else None,
        "diffs": _diffs(previous, code) if previous else [],
        "files": code,
        "calls": before(
            run.path,
            [each.summary.submit_started_at for at in (index - 1, index) if (each := submits.get(at))],
        )[-1],
        "workspace": changes(run.path, index),
        "episodes": episodes,
        "left_out": max(0, submit.summary.n_episodes - MAX_EPISODES),
    }


def _numbers(value: Any) -> list[float | None]:
    return (
        [each if isinstance(each, int | float) else None for each in value] if isinstance(value, list) else []
    )


def _at(values: Sequence[float | None], index: int) -> float | None:
    return values[index] if index < len(values) else None


def _diffs(before: Iterable[CodeFile], after: Iterable[CodeFile]) -> list[dict[str, Any]]:
    old = {file.path: file.text for file in before if file.text is not None}
    new = {file.path: file.text for file in after if file.text is not None}
    kinds = {"+": "ins", "-": "del", "@": "hunk"}
    return [
        {"path": one.path, "cut": one.cut, "lines": [(kinds.get(line[:1], ""), line) for line in one.lines]}
        for one in diff(old, new)
    ]


def episode_values(played: EpisodePlot | None) -> dict[str, Any]:
    """Charts of one episode."""
    if played is None:
        return {"charts": [], "note": "", "steps": 0}
    charts = [
        (title, Markup(svg))
        for title, series in (
            ("Reward", played.rewards),
            ("Observation", played.observations),
            ("Action", played.actions),
        )
        if (svg := chart(f"{title} over steps", "step", list(map(_line, series))))
    ]
    return {"charts": charts, "note": played.note, "steps": played.steps}


def _line(series: Series) -> Line:
    return Line(series.name, [(float(step), value) for step, value in enumerate(series.values)])
