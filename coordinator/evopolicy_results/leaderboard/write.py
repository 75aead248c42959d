"""Writes a leaderboard site.

    index.html          boards, files, runs, and what is not shown
    board-1/            the report of the first board's runs, with a page for each run; further boards beside it
    bundles/000.html    what the check of a file found
    episodes/*.html     the recorded held-out episodes of a run

A folder with any other content is refused. Texts of a file appear escaped, and only after its check.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from markupsafe import Markup

from evopolicy_common.errors import ConfigError
from evopolicy_results.html import notice, section
from evopolicy_results.html.pages import page, table_view
from evopolicy_results.leaderboard.bundles import Board, LabBundle, LabRun, boards
from evopolicy_results.publish.findings import KINDS
from evopolicy_results.reading.environments import title_of
from evopolicy_results.report import slug, write_report
from evopolicy_results.studies.palette import looks
from evopolicy_results.studies.study import Study, study_of
from evopolicy_results.tables.report_tables import tables_of

_MADE_BY = "Made by evopolicy leaderboard"
_SHOWN = ("leaderboard", "incomplete", "heldout", "cells", "pairs", "resolution")
"""Tables on the front page, by the first part of their names."""
_FOLDED = ("cells", "pairs")
_WIDTH, _HEIGHT = 240.0, 72.0
_LONG = 60
_WORDS = {"ok": "ok", "open": "open", "failed": "FAILED", "": "–"}

Tell = Callable[[str], None]


class Link(NamedTuple):
    """A cell with a link."""

    text: str
    href: str


Cell = str | int | float | Link


def write_site(
    bundles: Sequence[LabBundle], out: Path, *, title: str, tell: Tell = lambda text: None
) -> Path:
    """Writes the site and returns its `index.html`. Raises ConfigError when `out` holds anything else.

    An earlier site stays until the new one is whole.
    """
    _check(out)
    whole = out.resolve()
    partial = whole.with_name(f".{whole.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        _write_pages(bundles, partial, title, tell)
        _replace(whole, partial)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return out / "index.html"


def _write_pages(bundles: Sequence[LabBundle], out: Path, title: str, tell: Tell) -> None:
    all_boards = boards(bundles)
    for bundle in bundles:
        _write(out / bundle.page, _bundle_page(bundle))
    sections: list[dict[str, Any]] = []
    entries: set[str] = set()
    reference: str | None = None
    runs: list[tuple[Cell, ...]] = []
    for number, board in enumerate(all_boards, start=1):
        tell(f"board {number} of {len(all_boards)}: {len(board.runs)} runs")
        study = study_of(board.runs, allow_mixed=True, allow_unknown=True)
        folder = f"board-{number}"
        write_report(study, out / folder, title=f"{title}, board {number}")
        entries |= set(study.entries)
        reference = reference or study.reference
        sections.append(_board(board, study, number, folder))
        for bundle in board.bundles:
            for each in bundle.runs:
                run, name = each.run, slug(each.run)
                own, episodes = f"{folder}/traces/{name}.html", f"episodes/{name}-{number}.html"
                _write(out / episodes, _episodes(each, bundle, f"../{own}"))
                n = len(each.episodes)
                runs.append(
                    (
                        *(run.entry, title_of(run.env), run.record.repeat),
                        "–" if run.score is None else run.score,
                        Link(run.record.exp_id, own),
                        Link(f"{n} episodes", episodes) if n else "–",
                        *_named(bundle),
                    )
                )
    kinds = [kind for kind in KINDS if any(bundle.checked.state_of(kind) for bundle in bundles)]
    files: list[tuple[Cell, ...]] = []
    for bundle in bundles:
        left = sum(each.state != "published" for each in bundle.checked.listing)
        states = (_WORDS[bundle.checked.state_of(kind)] for kind in kinds)
        files.append((*_named(bundle), len(bundle.checked.runs), left, *states))
    refused = [(*_named(bundle), bundle.refused) for bundle in bundles if bundle.refused]
    columns = ";".join(("File;Signed by;Runs;Left out", *kinds))
    for ident, name, table in (
        ("files", "Files and checks", _table("files", "Published results", _FILES, columns, files)),
        ("runs", "Runs", _table("runs", "Runs", _RUNS, _RUN_COLUMNS, runs)),
        ("refused", "Not shown", _table("refused", "Not shown", _REFUSED, "File;Signed by;Why", refused)),
    ):
        if table["rows"] or ident == "files":
            sections.append(section(ident, name, tables=[table]))
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
        looks=looks(sorted(entries), reference),
        footer=f"{_MADE_BY} from published results, each checked before it is shown.",
        data="",
    )
    _write(out / "index.html", front)


def _check(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out} is a file; give a folder")
    ours = {"index.html", "bundles", "episodes"}
    there = sorted(out.iterdir()) if out.exists() else []
    others = [each.name for each in there if each.name not in ours and not each.name.startswith("board-")]
    index = out / "index.html"
    if there and not (index.is_file() and _MADE_BY in index.read_text(encoding="utf-8", errors="replace")):
        others.append("no index.html of a leaderboard")
    if others:
        raise ConfigError(
            f"--out {out} holds other files ({', '.join(others[:3])}); give a new or an earlier site's folder"
        )


def _replace(out: Path, new: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    # First the page by which `_check` knows a site, so that an interrupted command can be repeated.
    (new / "index.html").replace(out / "index.html")
    for each in out.iterdir():
        if each.is_dir() and not each.is_symlink():
            shutil.rmtree(each)
        elif each.name != "index.html":
            each.unlink()
    for each in new.iterdir():
        each.rename(out / each.name)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", errors="replace")


def _board(board: Board, study: Study, number: int, folder: str) -> dict[str, Any]:
    views = []
    for table in tables_of(study):
        kind = table.name.partition("_")[0]
        if kind in _SHOWN:
            view = table_view(table)
            files = [(label, f"{folder}/{href}") for label, href in view["files"]]
            views.append({**view, "id": f"{view['id']}-{number}", "files": files, "folded": kind in _FOLDED})
    suites = ", ".join(suite.title for suite in study.suites)
    name = "Leaderboard" if number == 1 else f"Board {number}"
    reasons_title = ""
    if board.unrecorded:
        reasons_title = (
            "These runs stand apart: their scores rest on the publisher's word, or their runs differ in"
        )
    elif board.mixed:
        reasons_title = "The runs of this file are no fair comparison; they differ in"
    elif board.apart:
        reasons_title = "These files stand apart: beside the first board their runs differ in"
    elif number > 1:
        reasons_title = "These files stand apart from the first board."
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
    " episodes of the selected checkpoint."
)
_REFUSED = "No run of these files is in a board."
_RUN_COLUMNS = "Entry;Environment;Repeat;Held-out mean;Run;Episodes;File;Signed by"
_LISTED = "Every run that the journal has of the published entries, in the order in which they were opened."
_LISTED_COLUMNS = "Run;Entry;Environment;Experiment;Repeat;Attempt;State;Replaced by"
_REMOVED = "What the publisher's command removed, in its words."


def _named(bundle: LabBundle) -> tuple[Cell, Cell]:
    return Link(bundle.file, bundle.page), bundle.label


def _bundle_page(bundle: LabBundle) -> str:
    checked = bundle.checked
    order = {kind: place for place, kind in enumerate(KINDS)}
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for each in sorted(checked.findings, key=lambda each: order.get(each.kind, len(order))):
        grouped.setdefault((each.kind, each.state, each.text), []).append(each.run)
    findings = [
        (
            *(_WORDS[state], kind, text, KINDS.get(kind, "")),
            named[0] if len(named) == 1 else f"{len(named)} runs",
        )
        for (kind, state, text), named in grouped.items()
    ]
    listed, removed = (
        list(map(msgspec.structs.astuple, each)) for each in (checked.listing, checked.removed)
    )
    left = [(str(each.path), each.reason) for each in bundle.left_out]
    tables = [
        _table("findings", "Checks", "", "Verdict;Check;Finding;Question;Run", findings),
        _table("listing", "Runs that were opened", _LISTED, _LISTED_COLUMNS, listed),
        _table("left-out", "Runs without a score", "", "Run;Why", left),
        _table("removed", "Removed before publication", _REMOVED, "What;Why", removed),
    ]
    states = [checked.state_of(kind) for kind in KINDS]
    return page(
        "site_bundle",
        title=bundle.file,
        lead=f"SHA-256 of the file: {bundle.sha256}. "
        + (f"Not shown: {bundle.refused}. " if bundle.refused else "")
        + (f"Signed by {bundle.signer}." if bundle.signer else "Without a valid signature."),
        facts=[
            ("signer", bundle.label),
            ("runs", len(checked.runs)),
            ("checks passed", states.count("ok")),
            ("open", states.count("open")),
            ("failed", states.count("failed")),
        ],
        tables=[tables[0], *(each for each in tables[1:] if each["rows"])],
    )


def _episodes(each: LabRun, bundle: LabBundle, run_page: str) -> str:
    cards = []
    for one, sums in each.episodes:
        text = f"return {one.episode_return:.4g}, {one.length} steps"
        if one.failure:
            text += f", the policy failed: {one.failure}"
        svg = _curve(sums, f"Sum of rewards in case {one.index}") if sums else ""
        cards.append({"index": one.index, "svg": svg, "text": text})
    return page(
        "site_episodes",
        title=f"{each.run.entry} on {title_of(each.run.env)}",
        lead=(
            "The sum of the recorded rewards over each episode. The command plays the recorded actions again in the"
            " installed environment and compares."
        ),
        command=f"evopolicy check {shlex.quote(bundle.file)} --replay all",
        page=run_page,
        cards=cards,
    )


def _checking(bundles: Sequence[LabBundle]) -> dict[str, Any]:
    identities = [f" --identity {each.signer}" if each.signer else "" for each in bundles]
    lines = [
        f"evopolicy check {shlex.quote(each.file)}{identity} --replay 5%"
        for each, identity in zip(bundles, identities, strict=True)
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


def _notices(bundles: Sequence[LabBundle]) -> list[dict[str, Any]]:
    shown = [bundle for bundle in bundles if not bundle.refused]
    unknown = [bundle.file for bundle in shown if bundle.checked.state_of("identity") != "ok"]
    not_replayed = [bundle.file for bundle in shown if bundle.checked.state_of("replay") != "ok"]
    processors = sorted({each[:200] for bundle in shown for each in bundle.processors})
    differ = len({each for bundle in shown for each in bundle.processors}) > 1
    found = (
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
            processors * differ,
        ),
    )
    return [notice(title, lines) for title, lines in found if lines]


def _table(
    ident: str, title: str, caption: str, columns: str, rows: Sequence[tuple[Cell, ...]]
) -> dict[str, Any]:
    """A table for the page; cells that are numbers sort as numbers. `columns`: their titles."""
    cells = [list(map(_cell, row)) for row in rows]
    return {
        "id": f"{ident}-table",
        "title": title,
        "caption": caption,
        "files": [],
        "filter": len(cells) > 8,
        "folded": False,
        "columns": [
            {"title": name, "numeric": bool(cells) and cells[0][place]["value"] is not None, "note": ""}
            for place, name in enumerate(columns.split(";"))
        ],
        "rows": cells,
    }


def _cell(cell: Cell) -> dict[str, Any]:
    text = cell.text if isinstance(cell, Link) else f"{cell:.4g}" if isinstance(cell, float) else str(cell)
    value = cell if isinstance(cell, int | float) else None
    return {
        "text": text,
        "value": value,
        "cls": "n" if value is not None else "long" if len(text) > _LONG else "",
        "href": cell.href if isinstance(cell, Link) else None,
        "entry": text if isinstance(cell, str) else None,
    }


def _curve(sums: Sequence[float], label: str) -> Markup:
    """The sum of rewards over an episode as a small line."""
    low, high = min(sums), max(sums)
    span = high - low or 1.0
    step = _WIDTH / max(1, len(sums) - 1)
    points = " ".join(
        f"{place * step:.1f},{4.0 + (_HEIGHT - 8.0) * (1.0 - (value - low) / span):.1f}"
        for place, value in enumerate(sums)
    )
    return Markup(
        '<svg role="img" aria-label="{}" viewBox="0 0 {:g} {:g}" style="width:100%;height:auto">'
        '<polyline points="{}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg>'
    ).format(label, _WIDTH, _HEIGHT, points)
