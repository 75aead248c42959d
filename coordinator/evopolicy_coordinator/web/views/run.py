"""The pages of one run, of one of its submits, and of an episode."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from evopolicy_common.messages.status import RetriedJobs
from evopolicy_common.records import model_calls
from evopolicy_common.records.policies.trees import changes
from evopolicy_common.records.summary import utc_text
from evopolicy_common.regular_files import NotThereError
from evopolicy_common.terminal import counted, duration, number, short
from evopolicy_coordinator.web.content.rendering import Words, ident, part, state_words
from evopolicy_coordinator.web.content.run_detail import IMAGES, MAX_WORDS, CodeFile, Detail, Happened
from evopolicy_coordinator.web.content.run_folders import FolderReader, RunFacts, ShownRuns
from evopolicy_results.behaviour.trace import Trace, diff, trace
from evopolicy_results.figures.line_chart import chart
from evopolicy_results.html import Notice, PageView
from evopolicy_results.html.run_page import run_view
from evopolicy_results.reading.reader import read_run
from evopolicy_results.reading.records import PastSubmit
from evopolicy_results.studies.palette import looks

MAX_EPISODES = 256


def live_run_view(
    run: RunFacts,
    runs: ShownRuns,
    reader: FolderReader,
    words: Words,
    *,
    retries: Sequence[RetriedJobs] = (),
) -> PageView:
    """One run: curve, submits, words, events. `retries`: the jobs of it that the cluster has played again."""
    may_show, path = runs.may_show(run), run.path
    traced = _traced(path, run.stamp) if path is not None and run.finished else None
    submits: Sequence[PastSubmit] = () if traced is None else traced.run.submits
    if path is not None and traced is None:
        submits = reader.submits(path)
    view = run_view(
        submits,
        traced,
        may_show=may_show,
        href=lambda submit: f"/run/{run.key}/submit/{submit.index}",
        entry=run.entry,
        env=run.env,
        look=looks(runs.entries, None).get(run.entry),
        facts=_run_facts(run, may_show),
        notices=_one_run_notices(run, may_show),
        budget=run.budget or 0,
        reference=("random, held-out", run.random) if may_show and run.random is not None else None,
        is_finished=run.finished,
        lists=("messages", "events"),
    )
    detail = None if path is None else Detail(path)
    messages = [] if detail is None else detail.messages(words.before)
    earlier = words.link(before=messages[0].at) if messages and messages[0].at > 0 else ""
    latest, parent = words.before is not None, runs.of(run.start.run) if run.start else None
    view.parts |= {
        "lineage": part("lineage", run=run, parent=parent, original=runs.of(run.replay_of)),
        "messages-more": part("messages_more", earlier=earlier, latest=latest, n=len(messages)),
    }
    for one in messages:
        name = f"message-{one.at}"
        view.row("messages", name, part("message", ident=name, one=one))
    events = [*([] if detail is None else detail.happened()), *map(_retried, retries)]
    for event in sorted(events, key=lambda each: each.at, reverse=True)[:MAX_WORDS]:
        name = ident("event", event.at, event.text)
        view.row("events", name, part("event", ident=name, one=event))
    return view


@lru_cache(maxsize=8)
def _traced(folder: Path, stamp: tuple[int, int]) -> Trace | None:
    """The trace of a finished run as a report has it; None for a run that a report leaves out. `stamp`: of its
    record."""
    try:
        return trace(read_run(folder))
    except Exception:  # an agent wrote the files; the rows then have what their summaries have
        return None


def _retried(one: RetriedJobs) -> Happened:
    jobs = counted(one.jobs, "job")
    text = {
        "worker_lost": f"Worker {one.worker} was lost with {jobs} of this run",
        "failed": f"{jobs} failed on worker {one.worker}, through no fault of the policy",
        "overdue": f"Worker {one.worker} held {jobs} for longer than any episode may take",
        "unlisted": f"Worker {one.worker} does not know of {jobs} that it was sent",
    }.get(one.failure, f"{jobs} on worker {one.worker}: {one.failure}")
    again = "It is played again" if one.jobs == 1 else "They are played again"
    at = utc_text(one.at)[:19].replace("T", " ")
    return Happened(at=at, level="warning", text=f"{text}. {again}, at no charge.")


def _run_facts(run: RunFacts, may_show: bool) -> list[tuple[str, str]]:
    is_scored, took = may_show and run.score is not None, run.finished and run.wall_s
    facts = {
        "state": state_words(run.state),
        "episodes used": f"{run.used} of {run.budget}" if run.budget else str(run.used),
        "submits": str(run.n_submits),
        "best train return": number(run.best),
        "held-out score": is_scored and number(run.score),
        "random": is_scored and number(run.random),
        "running, queued": (run.running or run.queued) and f"{run.running}, {run.queued}",
        "tokens": run.tokens and short(run.tokens),
        "cost": run.cost and f"${run.cost:.2f}",
        "jobs played again": run.retries and str(run.retries),
        "took": took and duration(run.wall_s),
        "time left, about": not took and run.remaining_s is not None and duration(run.remaining_s),
    }
    return [(name, str(value)) for name, value in facts.items() if value]


def _one_run_notices(run: RunFacts, may_show: bool) -> list[Notice]:
    notices: list[Notice] = []
    if run.waits_for:
        notices.append(Notice(f"It waits for {run.waits_for}."))
    if run.error:
        notices.append(Notice("Why it ended so", [run.error]))
    if run.finished and not may_show and run.state == "completed":
        notices.append(Notice("Its hidden scores are shown once no agent of a related run is alive."))
    if run.path is None:
        where = f" on {run.host}" if run.host else ""
        notices.append(Notice(f"Its folder is not on this host{where}: only the cluster's data are shown."))
    return notices


def submit_values(run: RunFacts, reader: FolderReader, index: int) -> dict[str, Any]:
    """The parts of one submit's page. NotThereError for a submit that is unknown or has no verdict yet."""
    submits = {one.index: one for one in (reader.submits(run.path) if run.path else ())}
    submit = submits.get(index)
    if run.path is None or submit is None:
        raise NotThereError(f"submit {index}")
    detail, may_read = Detail(run.path), run.finished
    code = detail.code(index, checkpoints=may_read)
    previous = detail.code(index - 1, checkpoints=may_read) if index - 1 in submits else ()
    summary, n = detail.summary(index), submit.n_episodes
    columns = [_numbers(summary.get(name))[:n] for name in ("env_instances", "returns", "episode_lengths")]
    failed = {int(each) for each in _numbers(summary.get("errors")) if each is not None}
    first, known = summary.get("first_global_episode"), detail.episodes(index)
    begin = first if isinstance(first, int) else known[0] if known else 0
    rows: Iterator[tuple[Any, ...]] = itertools.zip_longest(range(n), *columns)
    episodes = [
        {
            "number": begin + at,
            "kept": begin + at in known,
            "case": case,
            "value": value,
            "length": length,
            "failed": at in failed,
        }
        for at, case, value, length in itertools.islice(rows, MAX_EPISODES)
    ]
    starts = [each.started_at for at in (index - 1, index) if (each := submits.get(at))]
    return {
        "submit": submit,
        "previous": index - 1 if index - 1 in submits else None,
        "next": index + 1 if index + 1 in submits else None,
        "diffs": diff(_texts(previous), _texts(code)) if previous else [],
        "files": [(file.path, file.text) for file in code],
        "calls": model_calls.before(run.path, starts)[-1],
        "workspace": changes(run.path, index),
        "episodes": episodes,
        "left_out": max(0, n - MAX_EPISODES),
    }


def _numbers(value: object) -> list[float | None]:
    values = value if isinstance(value, list) else []
    return [each if isinstance(each, int | float) else None for each in values]


def _texts(files: Iterable[CodeFile]) -> dict[str, str]:
    return {file.path: file.text for file in files if file.text is not None}


def file_link(run: RunFacts, path: str) -> str:
    return f"/run/{run.key}/file?{urlencode({'path': path})}"


def episode_values(run: RunFacts, index: int, episode: int) -> dict[str, Any]:
    """The parts of one episode's page. NotThereError for an episode without a folder here."""
    if run.path is None:
        raise NotThereError(run.key)
    detail = Detail(run.path)
    place, names = detail.episode_files(index, episode)
    beside = detail.episodes(index)
    steps, lines, note = detail.played(place)
    charts = [(title, chart(f"{title} over steps", "step", series)) for title, series in lines.items()]
    texts = {name: detail.text(f"{place}/{name}") for name in ("error.txt", "stdout.txt", "stderr.txt")}
    links = {name: file_link(run, f"{place}/{name}") for name in names}
    return {
        "charts": [(title, Markup(svg)) for title, svg in charts if svg],
        "note": note,
        "steps": steps,
        "previous": episode - 1 if episode - 1 in beside else None,
        "next": episode + 1 if episode + 1 in beside else None,
        "texts": [(name, text) for name, text in texts.items() if text],
        "images": [(name, link) for name, link in links.items() if Path(name).suffix.lower() in IMAGES],
        "videos": [link for name, link in links.items() if name.endswith(".mp4")],
    }
