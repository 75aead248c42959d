"""Two boards of six entries from two labs that cheat: each row of the table in docs/how-to/publish.md.

Attacks, each with its defence:
- the cheats of six entries from two labs, found or not: each appears as [the page on publication](docs/how-
  to/publish.md#findings-for-each-cheat) says.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import agent, evopolicy, words
from publications import AGENT, ENV, Forger, read

from evopolicy_common.records import journal
from evopolicy_common.records.code_metrics import TREND, code_metrics
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile
from evopolicy_coordinator.pki import identity
from evopolicy_results.leaderboard.bundles import LabBundle, boards, read_bundles
from evopolicy_results.publish import contents, rules
from evopolicy_results.publish.archive import Archive
from evopolicy_results.publish.findings import Findings
from evopolicy_results.publish.replay import replay

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]
PAGE = Path(__file__).parents[3] / "docs/how-to/publish.md"
RUN, RESULT = f"runs/0000/{contents.RUN}", f"runs/0000/{contents.RESULT}"
RUNS = {
    "lab-a": [("a1", "one"), ("a2", "one"), ("a3", "one")],
    "lab-b": [("b1", "one"), ("b2", "one"), ("b2", "two"), ("b3", "one"), ("b3-again", "one")],
}


def another_processor(forger: Forger) -> None:
    def cpu(record: dict[str, Any]) -> None:
        record["versions"]["fingerprint"]["cpu"] = "x86_64 SSE2"

    forger.json(RUN, cpu)


def raised_rewards(forger: Forger) -> None:
    forger.rerecord("heldout-001", lambda row: (row.action, row.reward + 1.0), n=3)
    forger.raise_returns(lambda old: forger.returns("heldout-001"))

    def told(result: dict[str, Any]) -> None:
        result["fingerprint"]["cpu"] = "x86_64 SSE2"

    forger.begin_anew(told)
    another_processor(forger)


def another_model(forger: Forger) -> None:
    forger.json(RUN, lambda record: record["agent"].update(model_string="a-better-model"))


def doubled_key(forger: Forger) -> None:
    data = forger.files[RUN]
    forger.files[RUN] = data.replace(b'"model": ', b'"model": "x",\n  "model": ', 1)


def raised_score(forger: Forger) -> None:
    lines = forger.files[contents.JOURNAL]
    forger.raise_returns(lambda old: [each + 1.0 for each in old])
    forger.files[contents.JOURNAL] = lines


def working_time(forger: Forger) -> None:
    forger.json(RUN, lambda record: record["timing"].update(agent_s=0.001))


def begun_anew(forger: Forger) -> None:
    run = json.loads(forger.files[RUN])["run"].encode()
    own = [json.loads(each) for each in contents.journal_entries(forger.files[contents.JOURNAL])]
    left_out = {each["run"] for each in own if each.get("entry") == "b2"} - {run.decode()}
    forger.entries(lambda lines: [each for each in lines if json.loads(each).get("run") not in left_out])


def from_elsewhere(forger: Forger) -> None:
    source = b"class Policy: ...  # the actions were computed elsewhere\n"
    policy = bundles.pack([BundleFile("policy.py", False, source)])
    forger.files["runs/0000/checkpoints/001"] = policy.packed
    forger.begin_anew(lambda result: result["submits"][1].update(bundle=policy.digest))
    metrics = msgspec.to_builtins(code_metrics({"policy.py": source}))

    def told(record: dict[str, Any]) -> None:
        known = record["outcome"]["auxiliary"]
        known["code_metrics_by_submit"]["1"] = known["code_metrics_best"] = metrics
        for name in TREND:
            known["code_metrics_trend"][name][1] = metrics[name]

    forger.json(RUN, told)


def nothing(forger: Forger) -> None:
    """The cheat was done before the publication."""


Cheat = tuple[str, Callable[[Forger], None]]
BOARDS: tuple[dict[str, Cheat], ...] = (
    {
        "a1": ("none", nothing),
        "a2": ("held-out returns raised from the start, their recordings removed", Forger.invent_returns),
        "a3": ("name of the agent's model in `run.json` changed after the end", another_model),
        "b1": ("agent's working time changed", working_time),
        "b2": ("worse run left out, journal begun anew", begun_anew),
        "b3": ("recorded actions come from elsewhere, not from the policy", from_elsewhere),
    },
    {
        "a1": (
            "rewards raised from the start, and another processor model stated in `run.json`",
            raised_rewards,
        ),
        "a2": ("processor model in `run.json` changed after the end", another_processor),
        "a3": ("a key twice in `run.json`", doubled_key),
        "b1": ("score raised after the end", raised_score),
        "b2": ("worse run left out", nothing),
        "b3": ("attempts under other entry names", nothing),
    },
)
TABLE = {
    cells[0]: cells[1:]
    for line in PAGE.read_text().splitlines()
    if (cells := [cell.strip() for cell in line.strip("|").split("|")])[2:3] in (["0"], ["1"], ["3"])
}


class Labs:
    """Runs of two labs on the same cases, and one file for each entry and board."""

    def __init__(self, root: Path) -> None:
        self.root = root
        program = agent(root, AGENT)
        self.call(*words(f"data make --env {ENV} --root cases --train 4 --valid 2 --heldout 3"))
        for lab, runs in RUNS.items():
            options = words(f"--env {ENV} --budget 5 --data cases --state {lab} --runs {lab}-runs")
            for entry, name in runs:
                self.call("local", *options, "--agent", program, "--entry", entry, "--exp-id", name)
        self.heads: dict[str, str] = {}
        for number, cheats in enumerate(BOARDS):
            for entry, (_, cheat) in cheats.items():
                lab = "lab-a" if entry.startswith("a") else "lab-b"
                name = "two" if entry == "b2" else "one"
                out = f"{entry}-{number}.evp"
                folder = f"{lab}-runs/{entry}/{ENV.replace('/', '_')}/{name}"
                self.call("publish", folder, "--out", out, "--local", "--state", lab)
                forger = Forger(read(root / out))
                lines = contents.journal_entries(forger.files[contents.JOURNAL])
                self.heads[entry] = journal.heads(lines)[-2]
                cheat(forger)
                if cheat not in (nothing, doubled_key, raised_score):
                    forger.place()
                forger.sign(root / lab)
                forger.write(root / out)

    def call(self, *words: str) -> None:
        evopolicy(self.root, *words, code=0)

    def bundles(self, number: int) -> list[LabBundle]:
        """As the command reads the files of a board, with every episode played again."""

        def play(archive: Archive, checked: Findings) -> None:
            asyncio.run(replay(archive, checked, 1.0, lambda played, total: None))

        keys = {identity.public_key(self.root / lab): lab for lab in RUNS}
        files = [self.root / f"{entry}-{number}.evp" for entry in BOARDS[number]]
        return read_bundles(files, keys, self.root / f"unpacked-{number}", play)


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Labs:
    return Labs(tmp_path_factory.mktemp("cheats"))


@pytest.mark.parametrize("number", range(len(BOARDS)))
def test_a_board_shows_each_cheat_as_the_page_says(labs: Labs, number: int) -> None:
    files = labs.bundles(number)
    place = {bundle.file: "not shown" for bundle in files}
    for n, board in enumerate(boards(files)):
        for bundle in board.bundles:
            place[bundle.file] = "board of its own" if board.unrecorded else "first board" if n == 0 else "?"
    contradicted = {}
    for bundle in files:
        findings = bundle.checked.findings
        bundle.checked.findings = [each for each in findings if "of the same signer" not in each.text]
        contradicted[bundle.file] = len(bundle.checked.findings) < len(findings)
    # The journal that was begun anew, beside the other files of its lab.
    assert contradicted[f"b2-{number}.evp"] == (number == 0)
    for bundle in files:
        cheat, _ = BOARDS[number][bundle.file.partition("-")[0]]
        text, code, shown = TABLE[cheat]
        assert place[bundle.file] == shown, (cheat, bundle.refused)
        states = {
            kind: bundle.checked.state_of(kind) for kind in re.findall(r"`(\w+)`", text) if kind != "ok"
        }
        wanted = "failed" if "FAILED" in text.partition(";")[0] else "open"
        assert set(states.values()) <= {wanted}, (cheat, states)
        failed = any(each.state == "failed" for each in bundle.checked.findings)
        assert failed == (code == "1"), (cheat, bundle.refused)
        if text in ("all `ok`", "nothing; the journal lists them"):
            kinds = {each.kind for each in bundle.checked.findings if each.state == "open"}
            assert kinds <= {"claims", "completeness", "order", "policies"}, kinds


@pytest.mark.parametrize("number", range(len(BOARDS)))
def test_a_check_ends_with_the_code_of_the_page(labs: Labs, number: int) -> None:
    for entry, (cheat, _) in BOARDS[number].items():
        done = evopolicy(labs.root, "check", f"{entry}-{number}.evp", "--replay", "all")
        assert str(done.returncode) == TABLE[cheat][1], (cheat, done.stdout)


def test_a_journal_that_was_begun_anew_lacks_the_noted_head(labs: Labs) -> None:
    for number, failed in ((0, True), (1, False)):
        with Archive(labs.root / f"b2-{number}.evp") as archive:
            checked = rules.check(archive, heads=[labs.heads["b2"]])
        assert any(each.kind == "order" and each.state == "failed" for each in checked.findings) == failed


def test_the_table_of_the_page_has_the_cheats_of_the_boards() -> None:
    cheats = [name for board in BOARDS for name, _ in board.values()]
    assert sorted(TABLE) == sorted(cheats)


def test_the_site_says_why_a_run_stands_apart(labs: Labs) -> None:
    names = [f"{entry}-0.evp" for entry in BOARDS[0]]
    done = evopolicy(labs.root, "leaderboard", *names, "--out", "site", code=0)
    text = (labs.root / "site" / "index.html").read_text()
    assert "no replay can contradict the returns" in text
    assert "5 of 6 files" in done.stdout
