"""Entries of several signers stay apart whatever they call themselves, and a published run names no file of this
machine."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.errors import ConfigError
from evopolicy_common.records import journal
from evopolicy_common.records.run_record import Artifacts, decode_run_record
from evopolicy_results.leaderboard import write
from evopolicy_results.leaderboard.bundles import LabBundle, _compare_journals, _tell_apart, _unpack
from evopolicy_results.publish.findings import Findings, PublishedRun
from evopolicy_results.reading.reader import read_run

VERSIONS = [Version(policy(gain=1.0), (-200.0, -100.0), -180.0)]
A, B = "ab" * 32, "ab" * 4 + "cd" * 28
"""Keys with the same first digits."""


def bundle(root: Path, signer: str, lab: str, *entries: str) -> LabBundle:
    runs = [
        read_run(write_run(root / f"{signer}-{n}", VERSIONS, entry=entry, run=f"{root.name}-{n}"))
        for n, entry in enumerate(entries)
    ]
    return LabBundle(file="x.evp", sha256="", lab=lab, checked=Findings(signer=signer), runs=runs)


def entries(of: LabBundle) -> list[str]:
    return [run.entry for run in of.runs]


def test_entries_of_several_signers_get_their_names(tmp_path: Path) -> None:
    bundles = [bundle(tmp_path, A, "Lab-A", "evolve", "own"), bundle(tmp_path, B, "Lab-B", "evolve")]
    _tell_apart(bundles)
    assert [entries(each) for each in bundles] == [["evolve (Lab-A)", "own"], ["evolve (Lab-B)"]]


def test_files_of_one_signer_whose_journals_contradict_each_other_are_reported(tmp_path: Path) -> None:
    """Attack: two files of one signer from journals of which neither continues the other, in a
    leaderboard. Defence: the check `order` fails for both; their runs are shown, since nothing tells
    which one is true."""
    bundles = [bundle(tmp_path / str(n), signer, "", "evolve") for n, signer in enumerate((A, A, A, A, B))]
    lines = [b"first", b"second", b"third"]
    anew = [b"first", b"third"]
    for each, entered in zip(bundles, (lines[:2], lines, anew, [], anew), strict=True):
        each.file, each.heads = f"{len(entered)}.evp", journal.heads(entered)
    _compare_journals(bundles)
    told = [[each.text for each in one.checked.findings if each.state == "failed"] for one in bundles]
    assert [len(each) for each in told] == [0, 1, 1, 0, 0]
    assert "the first 2 entries are others in 3.evp of the same signer" in told[2][0]
    assert bundles[2].checked.state_of("order") == "failed"
    assert not any(each.refused for each in bundles)


def test_no_signer_gets_into_the_entry_of_another(tmp_path: Path) -> None:
    """Attack: an entry under the name of another signer's entry in a leaderboard. Defence: names are
    extended until each entry has one signer."""
    for n, (lab_a, lab_b, theirs) in enumerate(
        [
            ("Lab-A", "", ("evolve", "evolve (Lab-A)")),  # the name that the other's entry gets
            ("", "", ("evolve",)),  # keys with the same first digits
            ("Lab", "Lab", ("evolve",)),
        ]
    ):
        root = tmp_path / str(n)
        bundles = [bundle(root, A, lab_a, "evolve"), bundle(root, B, lab_b, *theirs)]
        _tell_apart(bundles)
        ours, others = map(entries, bundles)
        assert not set(ours) & set(others)
        assert len(set(others)) == len(theirs)


def test_runs_of_one_name_in_two_files_have_own_pages(tmp_path: Path) -> None:
    bundles = [bundle(tmp_path / name, A, "Lab-A", "evolve") for name in ("first", "second", "third")]
    _tell_apart(bundles)
    names = [bundle.runs[0].name for bundle in bundles]
    assert len(set(names)) == 3
    assert [name.rpartition(" (")[2] for name in names[1:]] == ["second-0)", "third-0)"]


def test_a_board_says_of_its_runs_in_which_file_they_are(tmp_path: Path) -> None:
    write.write_site([bundle(tmp_path, A, "Lab-A", "evolve")], tmp_path / "site")
    text = (tmp_path / "site" / "board-1" / "report.json").read_text()
    assert [each["path"] for each in json.loads(text)["runs"]] == ["x.evp/runs/exp"]
    assert str(tmp_path) not in text


def test_an_unpacked_run_names_no_files_of_this_machine(tmp_path: Path) -> None:
    """Attack: a `run.json` that names folders of the reader's machine as its workspace, logs or
    checkpoints. Defence: a leaderboard drops the names; `report` leaves out a run directory that names
    folders outside itself."""
    record = decode_run_record((write_run(tmp_path / "run", VERSIONS) / "run.json").read_bytes())
    hostile = msgspec.structs.replace(
        record, artifacts=Artifacts(workspace="/home", logs_agent="/etc/passwd", checkpoints="../..")
    )
    nothing: Any = SimpleNamespace(budget=0, submits=(), names=frozenset())
    run = PublishedRun(
        folder="runs/0000", record=hostile, opening=nothing, salt=b"", result=nothing, groups=(), opening_bytes=b"",
        result_bytes=b"", as_written={},
    )  # fmt: skip
    _unpack(nothing, run, tmp_path / "there")
    assert decode_run_record((tmp_path / "there" / "run.json").read_bytes()).artifacts == Artifacts()


def test_an_earlier_site_stays_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "site"
    first, second = (LabBundle(file=f"{n}.evp", sha256="", number=n, refused="torn") for n in (0, 1))
    index = write.write_site([first], out, title="First")
    with monkeypatch.context() as patched:
        patched.setattr(write, "page", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write.write_site([first, second], out, title="Second")
    assert "First" in index.read_text()
    assert [each.name for each in tmp_path.iterdir()] == ["site"]
    # A command that was killed leaves its unfinished folder, and can be repeated.
    (tmp_path / ".site.partial" / "bundles").mkdir(parents=True)
    write.write_site([first, second], out, title="Second")
    assert "Second" in index.read_text()
    assert sorted(each.name for each in out.rglob("*")) == ["000.html", "001.html", "bundles", "index.html"]


def test_a_page_that_is_no_leaderboard_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        write.write_site([], tmp_path, title="Board")
    assert (tmp_path / "index.html").read_text() == "mine"
