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
from typing import Any

from evopolicy_common.errors import ConfigError
from evopolicy_results.html import notice, section
from evopolicy_results.html.pages import page, table_view
from evopolicy_results.leaderboard.bundles import LabBundle, LabRun
from evopolicy_results.leaderboard.compare import Board, boards
from evopolicy_results.leaderboard.pages import Cell, Link, curve_svg, plain_view
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
_WORDS = {"ok": "ok", "open": "open", "failed": "FAILED", "": "–"}

Tell = Callable[[str], None]


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
    run_rows: list[list[Cell]] = []
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
                episodes = f"episodes/{slug(each.run)}-{number}.html"
                _write(out / episodes, _episodes(each, bundle, f"../{folder}/traces/{slug(each.run)}.html"))
                run_rows.append(_run_row(each, bundle, folder, episodes))
    sections.append(_files(bundles))
    if run_rows:
        columns = ("Entry", "Environment", "Repeat", "Held-out mean", "Run", "Episodes", "File", "Signed by")
        caption = (
            "Each run's page shows its submits, sources and their differences. Its recorded episodes are the held-out"
            " episodes of the selected checkpoint."
        )
        table = plain_view("runs", "Runs", caption, columns, run_rows)
        sections.append(section("runs", "Runs", tables=[table]))
    refused = [bundle for bundle in bundles if bundle.refused]
    if refused:
        rows: list[list[Cell]] = [[Link(each.file, each.page), each.label, each.refused] for each in refused]
        table = plain_view(
            "refused", "Not shown", "No run of these files is in a board.", ("File", "Signed by", "Why"), rows
        )
        sections.append(section("refused", "Not shown", tables=[table]))
    sections.append(_checking(bundles))
    n_runs = sum(len(bundle.runs) for bundle in bundles)
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
            ("runs", n_runs),
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


def _run_row(each: LabRun, bundle: LabBundle, folder: str, episodes: str) -> list[Cell]:
    run = each.run
    return [
        run.entry,
        title_of(run.env),
        run.record.repeat,
        "–" if run.score is None else run.score,
        Link(run.record.exp_id, f"{folder}/traces/{slug(run)}.html"),
        Link(f"{len(each.episodes)} episodes", episodes) if each.episodes else "–",
        Link(bundle.file, bundle.page),
        bundle.label,
    ]


def _files(bundles: Sequence[LabBundle]) -> dict[str, Any]:
    kinds = [kind for kind in KINDS if any(bundle.state_of(kind) for bundle in bundles)]
    rows: list[list[Cell]] = []
    for bundle in bundles:
        left = [each for each in bundle.checked.listing if each.state != "published"]
        rows.append(
            [
                Link(bundle.file, bundle.page),
                bundle.label,
                len(bundle.checked.runs),
                len(left),
                *(_WORDS[bundle.state_of(kind)] for kind in kinds),
            ]
        )
    caption = (
        "Each column after Left out is a check. ok: shown. open: this check cannot decide, or was not made. FAILED: the"
        " file contradicts itself, or another file of its signer. Left out: runs that the same coordinator opened for"
        " the same entries and that are not in the file."
    )
    table = plain_view(
        "files", "Published results", caption, ("File", "Signed by", "Runs", "Left out", *kinds), rows
    )
    return section("files", "Files and checks", tables=[table])


def _bundle_page(bundle: LabBundle) -> str:
    checked = bundle.checked
    order = {kind: place for place, kind in enumerate(KINDS)}
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for each in sorted(checked.findings, key=lambda each: order.get(each.kind, len(order))):
        grouped.setdefault((each.kind, each.state, each.text), []).append(each.run)
    findings: list[list[Cell]] = [
        [
            _WORDS[state],
            kind,
            text,
            KINDS.get(kind, ""),
            named[0] if len(named) == 1 else f"{len(named)} runs",
        ]
        for (kind, state, text), named in grouped.items()
    ]
    tables = [
        plain_view("findings", "Checks", "", ("Verdict", "Check", "Finding", "Question", "Run"), findings)
    ]
    rows: list[list[Cell]]
    if checked.listing:
        rows = [
            [
                each.run,
                each.entry,
                each.env,
                each.exp_id,
                each.repeat,
                each.attempt,
                each.state,
                each.replaced_by,
            ]
            for each in checked.listing
        ]
        columns = ("Run", "Entry", "Environment", "Experiment", "Repeat", "Attempt", "State", "Replaced by")
        text = (
            "Every run that the journal has of the published entries, in the order in which they were opened."
        )
        tables.append(plain_view("listing", "Runs that were opened", text, columns, rows))
    if bundle.left_out:
        rows = [[str(each.path), each.reason] for each in bundle.left_out]
        tables.append(plain_view("left-out", "Runs without a score", "", ("Run", "Why"), rows))
    if checked.removed:
        rows = [[each.what, each.why] for each in checked.removed]
        text = "What the publisher's command removed, in its words."
        tables.append(plain_view("removed", "Removed before publication", text, ("What", "Why"), rows))
    return page(
        "site_bundle",
        title=bundle.file,
        lead=f"SHA-256 of the file: {bundle.sha256}. "
        + (f"Not shown: {bundle.refused}. " if bundle.refused else "")
        + (f"Signed by {bundle.signer}." if bundle.signer else "Without a valid signature."),
        facts=[
            ("signer", bundle.label),
            ("runs", len(checked.runs)),
            ("checks passed", sum(bundle.state_of(kind) == "ok" for kind in KINDS)),
            ("open", sum(bundle.state_of(kind) == "open" for kind in KINDS)),
            ("failed", sum(bundle.state_of(kind) == "failed" for kind in KINDS)),
        ],
        tables=tables,
    )


def _episodes(each: LabRun, bundle: LabBundle, run_page: str) -> str:
    cards = []
    for one in each.episodes:
        text = f"return {one.episode_return:.4g}, {one.length} steps"
        if one.failure:
            text += f", the policy failed: {one.failure}"
        svg = curve_svg(one.sums, f"Sum of rewards in case {one.index}") if one.sums else ""
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
    lines = []
    for bundle in bundles:
        key = f" --identity {bundle.signer}" if bundle.signer else ""
        lines.append(f"evopolicy check {shlex.quote(bundle.file)}{key} --replay 5%")
    return section(
        "check",
        "Check it yourself",
        texts=[
            "Take each signer's key from a place that you know to be theirs, not from this page.",
            (
                "No check shows that recorded actions came from the policy, that a publisher did not start over with a"
                " new journal (unless you have an earlier head of it), or what a publisher states about jails and"
                " machines."
            ),
        ],
        code="\n".join(lines),
    )


def _notices(bundles: Sequence[LabBundle]) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    shown = [bundle for bundle in bundles if not bundle.refused]
    unknown = [bundle.file for bundle in shown if not bundle.known]
    if unknown:
        title = f"{len(unknown)} of {len(shown)} files are self-signed: nobody named their signer's key to this site."
        out.append(notice(title, unknown))
    not_replayed = [bundle.file for bundle in shown if bundle.state_of("replay") != "ok"]
    if not_replayed:
        title = (
            f"{len(not_replayed)} of {len(shown)} files were not replayed for this site: their rewards rest on the"
            " publisher's word."
        )
        out.append(notice(title, not_replayed))
    processors = {each for bundle in shown for each in bundle.processors}
    if len(processors) > 1:
        title = "The runs were played on processors with different features, which can change numbers in their last digits."  # noqa: E501
        out.append(notice(title, sorted(each[:200] for each in processors)))
    return out
