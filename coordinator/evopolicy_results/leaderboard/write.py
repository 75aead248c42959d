"""Writes a leaderboard site.

    index.html          boards, files, runs, and what is not shown
    board-1/            the report of the first board's runs, with a page for each run; further boards beside it
    bundles/000.html    the findings of a file's check
    episodes/*.html     the recorded held-out episodes of a run

A folder with any other content is refused. Texts of a file appear escaped, and only after its check.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_results.html import Notice, page, section
from evopolicy_results.html.pages import table_view
from evopolicy_results.leaderboard.bundles import Board, LabBundle, boards
from evopolicy_results.publish.findings import KINDS
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import PastRun
from evopolicy_results.report import check_folder, slug, write_file, write_report
from evopolicy_results.studies.palette import looks
from evopolicy_results.studies.study import Study, study_of
from evopolicy_results.tables.report_tables import tables_of

_MADE_BY = "Made by evopolicy leaderboard"
_SHOWN = ("leaderboard", "incomplete", "heldout", "cells", "pairs", "resolution")
"""Tables on the front page, by the first part of their names."""
_LONG = 60
_WORDS = {"ok": "ok", "open": "open", "failed": "FAILED", "": "–"}

Tell = Callable[[str], None]


class HtmlLink(NamedTuple):
    text: str
    href: str


CellValue = str | int | float | HtmlLink


def write_site(
    bundles: Sequence[LabBundle], out: Path, *, title: str = "Leaderboard", tell: Tell = lambda text: None
) -> Path:
    """Writes the site and returns its `index.html`. Raises ConfigError when `out` holds anything else.

    An earlier site stays until the new one is whole.
    """
    _check(out)
    whole = out.resolve()
    new = whole.with_name(f".{whole.name}.partial")
    try:
        shutil.rmtree(new, ignore_errors=True)
        _write_pages(bundles, new, title, tell)
        whole.mkdir(parents=True, exist_ok=True)
        # First the page by which `_check` knows a site, so that an interrupted command can be repeated.
        (new / "index.html").replace(whole / "index.html")
        for each in whole.iterdir():
            if each.is_dir() and not each.is_symlink():
                shutil.rmtree(each)
            elif each.name != "index.html":
                each.unlink()
        for each in new.iterdir():
            each.rename(whole / each.name)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return out / "index.html"


def _write_pages(bundles: Sequence[LabBundle], out: Path, title: str, tell: Tell) -> None:
    all_boards = boards(bundles)
    for bundle in bundles:
        write_file(out / bundle.page, _bundle_page(bundle))
    sections: list[dict[str, object]] = []
    entries: set[str] = set()
    reference: str | None = None
    runs: list[tuple[CellValue, ...]] = []
    for number, board in enumerate(all_boards, start=1):
        tell(f"board {number} of {len(all_boards)}: {len(board.runs)} runs")
        study = study_of(board.runs, allow_mixed=True)
        folder = f"board-{number}"
        places = {
            run.path: f"{each.file}/runs/{run.path.name}" for each in board.bundles for run in each.runs
        }
        write_report(study, out / folder, title=f"{title}, board {number}", places=places)
        entries |= set(study.entries)
        reference = reference or study.reference
        sections.append(_board(board, study, number, folder))
        for bundle in board.bundles:
            for run in bundle.runs:
                name, n = slug(run), len(bundle.episodes.get(run.record.run, ()))
                own, episodes = f"{folder}/traces/{name}.html", f"episodes/{name}-{number}.html"
                write_file(out / episodes, _episodes(run, bundle, f"../{own}"))
                runs.append(
                    (
                        *(run.entry, title_of(run.env), run.record.repeat),
                        "–" if run.score is None else run.score,
                        HtmlLink(run.record.exp_id, own),
                        "usual" if run.record.start is None else run.record.start.text[:_LONG],
                        HtmlLink(f"{n} episodes", episodes) if n else "–",
                        *_named(bundle),
                    )
                )
    kinds = [kind for kind in KINDS if any(bundle.checked.state_of(kind) for bundle in bundles)]
    files: list[tuple[CellValue, ...]] = []
    for bundle in bundles:
        checked = bundle.checked
        omitted = sum(each.state != "published" for each in checked.listing)
        states = (_WORDS[checked.state_of(kind)] for kind in kinds)
        files.append((*_named(bundle), len(checked.runs), omitted, *states))
    refused = [(*_named(bundle), bundle.refused) for bundle in bundles if bundle.refused]
    for ident, name, caption, columns, rows in (
        ("files", "Files and checks", _FILES, ";".join(("File;Signed by;Runs;Left out", *kinds)), files),
        (
            "runs",
            "Runs",
            _RUNS,
            "Entry;Environment;Repeat;Held-out mean;Run;Start;Episodes;File;Signed by",
            runs,
        ),
        ("refused", "Not shown", "No run of these files is in a board.", "File;Signed by;Why", refused),
    ):
        if rows or ident == "files":
            title_of_table = "Published results" if ident == "files" else name
            sections.append(
                section(ident, name, tables=[_table(ident, title_of_table, caption, columns, rows)])
            )
    sections.append(_checking(bundles))
    front = page(
        "index",
        title=title,
        lead=(
            "Published results of several labs, each file checked before it is shown. Scores are held-out means of the"
            " checkpoints that hidden validation selected."
        ),
        facts=[
            ("signers", len({bundle.signer for bundle in bundles if bundle.signer})),
            ("files", len(bundles)),
            ("entries", len(entries)),
            ("runs", len(runs)),
            ("not shown", len(refused)),
        ],
        notices=_notices(bundles),
        sections=sections,
        answers=None,
        looks=looks(sorted(entries), reference),
        footer=f"{_MADE_BY} from published results, each checked before it is shown.",
        data="",
    )
    write_file(out / "index.html", front)


def _check(out: Path) -> None:
    index = out / "index.html"
    is_site = index.is_file() and _MADE_BY in index.read_text(encoding="utf-8", errors="replace")
    names = {"index.html", "bundles", "episodes"}
    check_folder(out, lambda name: is_site and (name in names or name.startswith("board-")), "site")


def _board(board: Board, study: Study, number: int, folder: str) -> dict[str, object]:
    views = []
    for table in tables_of(study):
        if table.name in _SHOWN:
            view = table_view(table)
            files = [(label, f"{folder}/{href}") for label, href in view["files"]]
            views.append({**view, "id": f"{view['id']}-{number}", "files": files})
    suites = ", ".join(suite.title for suite in study.suites)
    name = "Leaderboard" if number == 1 else f"Board {number}"
    reasons_title = "These files stand apart from the first board." if number > 1 else ""
    if board.unrecorded:
        reasons_title = (
            "These runs stand apart: their scores rest on the publisher's word, or their runs differ in"
        )
    elif board.mixed:
        reasons_title = "The runs of this file are no fair comparison; they differ in"
    elif board.apart:
        reasons_title = (
            "These files are on a board of their own: their runs differ from those of the first in"
        )
    return section(
        f"board-{number}",
        name,
        title=f"{name}: {suites}",
        texts=[
            "Intervals are at 95 %. Entries that share a letter in Tie group do not differ significantly."
        ],
        reasons=board.apart,
        reasons_title=reasons_title,
        tables=views,
        links=[
            ("The whole report of these runs", f"{folder}/index.html"),
            *((f"{bundle.file}, signed by {bundle.label}", bundle.page) for bundle in board.bundles),
        ],
    )


_FILES = (
    "Each column after Left out is a check. ok: shown. open: this check cannot decide, or was not made."
    " FAILED: the file contradicts itself, or another file of its signer. Left out: runs that the same"
    " coordinator opened for the same entries and that are not in the file."
)
_RUNS = (
    "Each run's page shows its submits, sources and their differences. Its recorded episodes are the held-out"
    " episodes of the selected checkpoint. A run whose Start is a submit of another run is on no leaderboard: that"
    " run's work and budget are in its score."
)


def _named(bundle: LabBundle) -> tuple[CellValue, CellValue]:
    return HtmlLink(bundle.file, bundle.page), bundle.label


def _bundle_page(bundle: LabBundle) -> str:
    checked = bundle.checked
    findings = [
        (_WORDS[state], kind, text, KINDS[kind], by) for (kind, state, text), by in checked.grouped().items()
    ]
    listed, removed = (
        list(map(msgspec.structs.astuple, each)) for each in (checked.listing, checked.removed)
    )
    without_score = [(str(each.path), each.reason) for each in bundle.left_out]
    tables = [
        _table("findings", "Checks", "", "Verdict;Check;Finding;Question;Run", findings),
        _table(
            "listing",
            "Runs that were opened",
            "Every run that the journal has of the published entries, in the order in which they were opened.",
            "Run;Entry;Environment;Experiment;Repeat;Attempt;State;Replaced by",
            listed,
        ),
        _table("left-out", "Runs without a score", "", "Run;Why", without_score),
        _table(
            "removed",
            "Removed before publication",
            "Removed by the publisher's command, in its words.",
            "What;Why",
            removed,
        ),
    ]
    return page(
        "site_bundle",
        title=bundle.file,
        bundle=bundle,
        states=[checked.state_of(kind) for kind in KINDS],
        tables=[tables[0], *(each for each in tables[1:] if each["rows"])],
    )


def _episodes(run: PastRun, bundle: LabBundle, run_page: str) -> str:
    return page(
        "site_episodes",
        title=f"{run.entry} on {title_of(run.env)}",
        command=f"evopolicy check {shlex.quote(bundle.file)} --replay all",
        page=run_page,
        episodes=[(episode, _points(sums)) for episode, sums in bundle.episodes.get(run.record.run, ())],
    )


def _checking(bundles: Sequence[LabBundle]) -> dict[str, object]:
    lines = [
        f"evopolicy check {shlex.quote(each.file)}{f' --identity {each.signer}' * bool(each.signer)} --replay 5%"
        for each in bundles
    ]
    texts = [
        "Take each signer's key from a place that you know to be theirs, not from this page.",
        (
            "No check shows that recorded actions came from the policy, that a publisher did not start over"
            " with a new journal (unless you have an earlier head of it), or what a publisher states about"
            " jails and machines."
        ),
    ]
    return section("check", "Check it yourself", texts=texts, code="\n".join(lines))


def _notices(bundles: Sequence[LabBundle]) -> list[Notice]:
    shown = [bundle for bundle in bundles if not bundle.refused]
    unknown = [bundle.file for bundle in shown if bundle.checked.state_of("identity") != "ok"]
    not_replayed = [bundle.file for bundle in shown if bundle.checked.state_of("replay") != "ok"]
    processors = sorted({each for bundle in shown for each in bundle.processors})
    notices = (
        (
            f"{len(unknown)} of {len(shown)} files are self-signed: nobody named their signer's key to this"
            " site.",
            unknown,
        ),
        (
            f"{len(not_replayed)} of {len(shown)} files were not replayed for this site: their rewards rest on the"
            " publisher's word.",
            not_replayed,
        ),
        (
            "The runs were played on processors with different features, which can change numbers in their"
            " last digits.",
            [each[:200] for each in processors] if len(processors) > 1 else [],
        ),
    )
    return [Notice(title, lines) for title, lines in notices if lines]


def _table(
    ident: str, title: str, caption: str, columns: str, rows: Sequence[tuple[CellValue, ...]]
) -> dict[str, object]:
    """A table for the page; cells that are numbers sort as numbers. `columns`: their titles."""
    cells = [list(map(_cell, row)) for row in rows]
    return {
        "id": f"{ident}-table",
        "title": title,
        "caption": caption,
        "files": [],
        "filter": len(cells) > 8,
        "method": "",
        "short": False,
        "columns": [
            {"title": name, "numeric": bool(cells) and cells[0][place]["value"] is not None, "note": ""}
            for place, name in enumerate(columns.split(";"))
        ],
        "rows": cells,
    }


def _cell(cell: CellValue) -> dict[str, object]:
    text = (
        cell.text if isinstance(cell, HtmlLink) else f"{cell:.4g}" if isinstance(cell, float) else str(cell)
    )
    value = cell if isinstance(cell, int | float) else None
    return {
        "text": text,
        "value": value,
        "cls": "n" if value is not None else "long" if len(text) > _LONG else "",
        "href": cell.href if isinstance(cell, HtmlLink) else None,
        "entry": text if isinstance(cell, str) else None,
    }


def _points(sums: Sequence[float]) -> str:
    """The sum of rewards over an episode as the points of a line in the page's drawing, of 240 by 72."""
    if not sums:
        return ""
    low, span = min(sums), max(sums) - min(sums) or 1.0
    step = 240.0 / max(1, len(sums) - 1)
    return " ".join(
        f"{place * step:.1f},{4.0 + 64.0 * (1.0 - (value - low) / span):.1f}"
        for place, value in enumerate(sums)
    )
