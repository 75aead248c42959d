"""A published run that starts from another run's submit is shown as such, under the conditions of its whole line.

Attacks, each with its defence:
- an entry submits another run's policy once, and is published as a run of its own: the start is an open
  finding, marked on card and leaderboard, and no run of the entry's mean.
- the run before, with another entry's name, is left out: completeness counts it.
- an agent without a jail, or policies without a sandbox, work in the run before: the coordinator hands on
  their conditions in the start, and commits to them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from commands import agent, evopolicy, record_in, run_dir, words
from publications import CONSTANT, Forger, Held, read

from evopolicy_common.messages.run_settings import Line
from evopolicy_results.publish import contents, rules

pytestmark = pytest.mark.system

NUMBERS = words("--env toy/line --budget 5 --validation 2 --heldout 3 --state st")
PARENT = f"submit_policy({CONSTANT.format(0)!r}, [0, 1])"
WEAKEST = Line(jail="none", sandbox_tier="none", metering="nothing")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `child.evp`, the child alone, and `line.evp`, all runs."""
    root = tmp_path_factory.mktemp("starts")
    own = ("--agent", agent(root, PARENT), "--jail", "none", "--tier", "none")
    evopolicy(root, "local", *NUMBERS, *own, "--entry", "explorer", "--exp-id", "first", code=0)
    place = run_dir(root, exp_id="first").relative_to(root)
    start = ("--agent", agent(root, "submit([0])"), "--start-from", f"{place}@submit_000")
    evopolicy(root, "local", *NUMBERS, *start, "--entry", "mine", "--exp-id", "second", code=0)
    state = words("--local --state st")
    child = str(run_dir(root, exp_id="second").relative_to(root))
    evopolicy(root, "publish", child, "--out", "child.evp", *state, code=0)
    evopolicy(root, "publish", "runs", "--out", "line.evp", *state, code=0)
    return root


def told(files: dict[str, bytes], kind: str) -> list[tuple[str, str]]:
    return [(each.state, each.text) for each in rules.check(Held(files)).findings if each.kind == kind]


def test_a_start_inherits_the_weakest_conditions_of_its_line(published: Path) -> None:
    record = record_in(run_dir(published, exp_id="second"))
    assert (record.jail, record.sandbox_tier) == ("bwrap", "bwrap")
    assert record.start is not None
    assert record.start.line == record.line == WEAKEST
    card = json.loads(read(published / "child.evp")[contents.CARD])
    assert card["conditions"]["isolation"]["agents' jail"] == {"none": 1}
    assert card["conditions"]["isolation"]["policies' sandbox"] == {"none": 1}
    assert "policies ran outside the sandbox" in " ".join(card["limits"])


def test_a_start_is_an_open_finding_and_its_parent_is_missed(published: Path) -> None:
    files, parent = read(published / "child.evp"), record_in(run_dir(published, exp_id="first")).run
    checked = rules.check(Held(files))
    assert not checked.failed, checked.findings
    ((state, text),) = told(files, "starts")
    assert (state, f"submit 0 of {parent}" in text) == ("open", True)
    ((state, text),) = told(files, "completeness")
    assert (state, text.partition(" are left out")[0]) == (
        "open",
        "1 of 2 runs of these entries and their starts",
    )
    assert [(each.entry, each.state) for each in checked.listing] == [
        ("explorer", "completed"),
        ("mine", "published"),
    ]
    done = evopolicy(published, "check", "child.evp", code=0)
    assert f"open   starts: it starts from submit 0 of {parent}" in done.stdout


def test_a_card_marks_a_start_and_keeps_it_out_of_means(published: Path) -> None:
    files = read(published / "line.evp")
    card = json.loads(files[contents.CARD])
    parent = record_in(run_dir(published, exp_id="first")).run
    assert {(each["entry"], each["start"], each["runs"]) for each in card["results"]} == {
        ("explorer", "", 1),
        ("mine", f"submit 0 of {parent}", 1),
    }
    # Runs are in the order of their ids, which are drawn.
    assert sorted(each["start"] for each in card["runs"]) == ["", f"submit 0 of {parent}"]
    assert "Some runs start from a submit of another run" in " ".join(card["limits"])
    assert f"mine, from submit 0 of {parent}" in files[contents.CARD_TEXT].decode()


def test_a_start_is_marked_on_a_leaderboard_and_ranked_on_none(published: Path) -> None:
    for name, entries in (("child", set()), ("line", {"explorer"})):
        evopolicy(published, "leaderboard", f"{name}.evp", "--out", f"site-{name}", code=0)
        index = (published / f"site-{name}" / "index.html").read_text()
        assert "on no leaderboard" in index
        assert "submit 0 of r-" in index
        table = published / f"site-{name}" / "board-1" / "tables"
        ranked = {
            line.split(",")[0]
            for path in table.glob("leaderboard*.csv")
            for line in path.read_text().splitlines()
        }
        assert ranked & {"explorer", "mine"} == entries


def drop(document: Any, *names: str) -> None:
    for name in names:
        document = document[name]
    document["start"] = None


@pytest.mark.parametrize("how", ["journal", "opening", "record", "conditions", "workspace", "parent's entry"])
def test_a_start_that_is_denied_is_found(published: Path, how: str) -> None:
    name = next(
        name
        for name in ("runs/0000", "runs/0001")
        if json.loads(read(published / "line.evp")[f"{name}/{contents.RUN}"])["start"]
    )
    forger = Forger(read(published / "line.evp"))
    kind, text = "commitment", "another entry, environment, experiment, epoch or start"
    match how:
        case "journal":
            forger.entries(lambda lines: [changed(line, start=None) for line in lines])
        case "opening":
            forger.json(f"{name}/{contents.OPENING}", lambda opening: drop(opening, "settings"))
        case "record":
            forger.json(f"{name}/{contents.RUN}", drop)
            kind, text = "record", "run.json has start"
        case "conditions":
            line = {"jail": "bwrap", "sandbox_tier": "bwrap", "metering": "nothing"}
            forger.json(
                f"{name}/{contents.OPENING}", lambda opening: opening["settings"]["start"].update(line=line)
            )
            text = "its start records jail 'bwrap' of the runs before"
        case "workspace":
            forger.json(
                f"{name}/{contents.OPENING}",
                lambda opening: opening["settings"]["start"].update(tree="ab" * 32),
            )
            text = "another workspace than submit 0 of"
        case _:
            forger.entries(lambda lines: [line for line in lines if b'"entry":"explorer"' not in line])
            kind, text = "journal", "of which the journal has no entry"
    forger.sign()
    found = told(forger.files, kind)
    assert any(state == "failed" and text in each for state, each in found), found


def changed(line: bytes, **fields: Any) -> bytes:
    entry = json.loads(line)
    return contents.document({**entry, **fields}).rstrip(b"\n") if "start" in entry else line
