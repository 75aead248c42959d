"""Tables in their written forms, the palette, phases, and the agent's log."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest
from invented.policies import Version, png, policy
from invented.run_dirs import write_run
from invented.small_table import TABLE

from evopolicy_results.behaviour.edits import classify, events_of, phases
from evopolicy_results.behaviour.trace import trace
from evopolicy_results.figures.plot import inline_svg
from evopolicy_results.figures.policies import wilson
from evopolicy_results.figures.style import new_figure, svg_text
from evopolicy_results.reading.agent_log import LogReading, read_agent_log
from evopolicy_results.reading.reader import read_run
from evopolicy_results.reading.records import PastRun
from evopolicy_results.studies.study import study
from evopolicy_results.tables.report_tables import tables_of
from evopolicy_results.tables.table import Column, Table, best_marks, to_csv, to_markdown


def test_csv_keeps_full_precision_and_empty_fields() -> None:
    found = list(csv.DictReader(io.StringIO(to_csv(TABLE))))
    assert found[0] == {"who": "A & B_1", "x": "1.23456", "share": "0.5", "n": "3"}
    assert found[1]["x"] == ""


def test_markdown_marks_best_and_second_and_escapes_pipes() -> None:
    lines = to_markdown(TABLE).splitlines()
    assert "| A & B_1 | **1.23** | 50 % | **3** |" in lines
    assert "| C\\|D | – | 13 % | 0 |" in lines
    assert "| E | *0.00* | – | **3** |" in lines


def table_of(text: str) -> Table:
    columns = (Column("x", "X", "number"), Column("who", "Who"))
    return Table(name="t", title="T", caption="", columns=columns, rows=({"who": text, "x": -1.5},))


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("=HYPERLINK(1)", "'=HYPERLINK(1)"),
        ("+1+cmd", "'+1+cmd"),
        ("-1-cmd", "'-1-cmd"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("\t=1", "'\t=1"),
        ("-1.5", "-1.5"),
        ("-0.300 to +1.2e-05", "-0.300 to +1.2e-05"),
        ("a=b", "a=b"),
        ("\x1b]8;;http://evil\x1b\\x", "\ufffd]8;;http://evil\ufffd\\x"),
    ],
)
def test_csv_holds_no_formula_and_nothing_that_steers_a_terminal(text: str, written: str) -> None:
    assert list(csv.reader(io.StringIO(to_csv(table_of(text))))) == [["x", "who"], ["-1.5", written]]


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)&gt;"),
        ("![x](http://evil/x.png)", "!\\[x\\](http://evil/x.png)"),
        ("a\\|b", "a\\\\\\|b"),
        ("`<b>`\nx", "\\`&lt;b&gt;\\` x"),
        ("\x1b[2J", "\ufffd\\[2J"),
    ],
)
def test_markdown_shows_text_and_no_html_links_or_images(text: str, written: str) -> None:
    assert to_markdown(table_of(text)).splitlines()[-1] == f"| -1.500 | {written} |"


def test_equal_best_values_share_the_mark_and_leave_no_second() -> None:
    assert best_marks([{"x": 1.0}, {"x": 1.0}, {"x": 0.0}], ["x"]) == {(0, "x"): 1, (1, "x"): 1}
    assert best_marks([{"x": 1.0}], ["x"]) == {}


def test_phases_join_adjacent_edits_and_pass_over_events(tmp_path: Path) -> None:
    versions = [
        Version(policy(gain=1.0), (0.0,) * 4, 1.0),
        Version(policy(gain=2.0), (0.0,) * 4, 2.0),
        Version(policy(gain=2.0), (0.0,) * 4, 2.0),  # retest inside the parametric phase
        Version(policy(gain=3.0), (0.0,) * 4, 1.5),
        Version(policy(gain=3.0, planner=True), (0.0,) * 4, 3.0),
        Version(policy(gain=3.0), (0.0,) * 4, 1.5),  # rollback
    ]
    found = classify(read_run(write_run(tmp_path, versions)).submits)
    assert phases(found) == [(0, 4, "first"), (4, 16, "parametric"), (16, 24, "synthesis")]
    assert [events_of(t) for t in found] == [
        ["hit"], ["hit"], ["miss", "retest"], ["miss"], ["hit"], ["miss", "rollback"],
    ]  # fmt: skip


def test_wilson_interval_is_the_published_one() -> None:
    low, high = wilson(10, 20)
    assert (round(low, 3), round(high, 3)) == (0.299, 0.701)
    assert wilson(0, 5)[0] == 0.0
    assert wilson(5, 5)[1] == 1.0


@pytest.mark.filterwarnings("error")
def test_a_name_without_glyphs_is_drawn_without_a_warning() -> None:
    with new_figure(2.0, 1.0) as (figure, axes):
        axes[0][0].set_title("模型甲\x1b[31m")
    svg = svg_text(figure, "a")
    assert "模型甲" in svg
    assert "\x1b" not in svg


def test_inline_svg_is_themed_named_and_has_ids_of_its_own() -> None:
    with new_figure(2.0, 1.0) as (figure, axes):
        axes[0][0].plot([0, 1], [0, 1])
        axes[0][0].set_title("cost in $ of a_b$")
    svg = svg_text(figure, "a")
    assert svg == svg_text(figure, "a")
    one, two = inline_svg(svg, "a", 'an "alt" <text>'), inline_svg(svg, "b", "b")
    assert 'aria-label="an &quot;alt&quot; &lt;text>"' in one
    assert "var(--ink)" in one
    assert "cost in $ of a_b$" in one
    ids = [{part.split('"')[0] for part in text.split(' id="')[1:]} for text in (one, two)]
    assert ids[0]
    assert not ids[0] & ids[1]


VERSIONS = [
    Version(policy(gain=1.0), (0.0,) * 4, 1.0, says="I start simple."),
    Version(policy(gain=2.0), (0.0,) * 4, 2.0, says="It is too slow.", images={"probe.png": png()}),
    Version({"policy.py": "import nope\n"}, (0.0,), None, "import_error"),
    Version(policy(gain=2.5), (0.0,) * 4, 3.0, says="Back to work."),
]


@pytest.mark.parametrize("form", ["claude", "codex"])
def test_log_gives_each_submit_what_was_read_and_said_before_it(tmp_path: Path, form: str) -> None:
    run = read_run(write_run(tmp_path, VERSIONS, log=form))
    found = trace(run)
    evidence = found.evidence
    said = ["I start simple.", "It is too slow.", "", "Back to work."]
    assert [one.attribution for one in evidence.values()] == said
    assert evidence[0].read == ()
    assert evidence[1].read[0] == "feedback/submit_000/summary.json"
    assert [path.name for path in found.images[1]] == ["probe.png"]
    assert found.unplaced == ()


def test_log_without_answers_or_times_is_not_guessed_into_place(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS, log="turns"))
    reading = read_agent_log(run.path / "logs/agent.jsonl", run.submits)
    assert reading.by_submit == {}
    assert reading.unplaced == ("I start simple.", "It is too slow.", "submit 2", "Back to work.")


def read_lines(run: PastRun, *lines: bytes | dict[str, object]) -> LogReading:
    """The reading of an agent's log with these lines."""
    log = run.path / "agent.jsonl"
    log.write_bytes(b"\n".join(one if isinstance(one, bytes) else json.dumps(one).encode() for one in lines))
    return read_agent_log(log, run.submits)


def test_plain_lines_that_begin_with_a_submits_name_tell_its_place(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS[:2], log=None))
    lines = ["gain 1.0", "submit_000: ok, mean 3.5", "gain 2.0 looks better", "submit_001: ok", "bye"]
    reading = read_lines(run, *({"type": "stdout", "text": line} for line in lines))
    assert [one.attribution for one in reading.by_submit.values()] == ["gain 1.0", "gain 2.0 looks better"]
    assert reading.unplaced == ("submit_001: ok", "bye")


def test_stamped_lines_are_placed_by_time(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS[:2], log=None))
    said = ("2020-01-01T00:00:00Z", run.submits[1].started_at, "2040-01-01T00:00:00Z")
    texts = zip(("early", "between", "late"), said, strict=True)
    lines = ({"turn": turn, "text": text, "timestamp": at} for turn, (text, at) in enumerate(texts))
    reading = read_lines(run, *lines)
    placed = {index: one.messages for index, one in reading.by_submit.items()}
    assert placed == {0: ("early",), 1: ("between",)}
    assert reading.unplaced == ("late",)


def test_damaged_or_strange_log_lines_are_passed_over(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS[:1], log=None))
    strange = [b"\xff\xfe", b"[1, 2]", b'{"type": 7}', b'"text"', b"[" * 100_000]
    strange.append(b'{"type": "assistant", "message": [1]}')
    strange.append(b'{"type": "assistant", "message": {"content": "\xd6 "}}')
    strange.append(b'{"turn": 1, "text": "hello"}')
    strange.append(b'{"type": "item.completed", "item": {"type": "command_execution", "command": null}}')
    assert read_lines(run, *strange).unplaced == ("hello",)
    assert read_agent_log(tmp_path / "absent", run.submits).unplaced == ()


def test_foreign_environments_have_their_runs_titles_and_families(tmp_path: Path) -> None:
    told = [
        ("my/glider", "Glider\x1b[2J\n" + "x" * 99, "score"),
        ("my/kite", "", "air"),
        ("gym/acrobot", "Not acrobot", "air"),
        ("my/easy", " ACROBOT ", "air"),
    ]
    for entry, kite in (("A", "Kite"), ("B", "Dragon")):
        for env, title, family in told:
            names = {"env_title": title or kite, "env_family": family}
            write_run(tmp_path, [Version(policy(gain=1.0), (1.0,), 1.0)], entry=entry, env=env, change=names)
    tables = {table.name: table for table in tables_of(study([tmp_path]))}
    rows = {row["id"]: (row["env"], row["family"]) for row in tables["environments"].rows}
    assert rows["gym/acrobot"] == ("Acrobot", "Gym / Box2D")
    # A title that another environment ships with.
    assert rows["my/easy"] == ("my/easy", "Air")
    # Two runs that name it differently.
    assert rows["my/kite"] == ("my/kite", "Other")
    title, family = rows["my/glider"]
    assert (title[:6], len(title), "\x1b" in title, family) == ("Glider", 60, False, "Score")
    # A family's name does not take the place of a column.
    (row, *_) = tables["leaderboard"].rows
    assert {"family_score", "family_other", "score"} <= row.keys()
