"""Evaluation cards: made from the runs, made again by the check, and valid for others' tools."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from commands import evopolicy
from publications import Forger, Held, Results

from evopolicy_common.catalogue.installs import licences
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions, rules
from evopolicy_results.publish.findings import Findings

pytestmark = pytest.mark.system

VALIDATE = """
import json, socket, sys
def refuse(*_): raise OSError("no network")
socket.socket.connect = socket.getaddrinfo = refuse
import mlcroissant
dataset = mlcroissant.Dataset(sys.argv[1])
issues = dataset.metadata.ctx.issues
records = [
    {name: value.decode() if isinstance(value, bytes) else value for name, value in each.items()}
    for each in dataset.records("runs")
]
limits = dataset.metadata.data_limitations
print(json.dumps([sorted(issues.errors), sorted(issues.warnings), records, limits], default=float))
"""


def card_of(results: Results) -> cards.Card:
    return msgspec.json.decode(results.files[contents.CARD], type=cards.Card)


def checked(results: Results, forger: Forger) -> Findings:
    """Signed by the publisher itself."""
    forger.sign(results.root / "st")
    return rules.check(Held(forger.files), results.summary["signer"])


def states(result: Findings, kind: str = "card") -> list[str]:
    return [each.state for each in result.findings if each.kind == kind]


def validated(
    description: Path, home: Path
) -> tuple[list[str], list[str], list[dict[str, object]], list[str]]:
    """Errors, warnings, records of the runs, and limits, as `mlcroissant` reads them without a network."""
    command = [sys.executable, "-c", VALIDATE, str(description)]
    env = {**os.environ, "HOME": str(home)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    errors, warnings, records, limits = json.loads(done.stdout.splitlines()[-1])
    return errors, warnings, records, limits


def test_a_card_tells_what_the_runs_tell(results: Results) -> None:
    card, run = card_of(results), json.loads(results.files["runs/0000/run.json"])
    assert card.runs[0].score == run["outcome"]["final_score"]
    assert card.results[0].mean == sum(each.score or 0.0 for each in card.runs) / 2
    assert [(each.entry, each.runs, each.episodes) for each in card.agents] == [("mine", 2, 10)]
    assert card.conditions["isolation"]["agents' jail"] == {"bwrap": 2}
    assert card.signer == results.summary["signer"]
    text = results.files[contents.CARD_TEXT].decode()
    assert all(limit in text for limit in card.limits)
    assert f"`{card.signer}`" in text


def described(results: Results, card: cards.Card) -> Forger:
    """The files with another card, and descriptions that follow from it."""
    forger = Forger(results.files)
    digests = {name: contents.digest(data) for name, data in forger.files.items()}
    forger.files |= descriptions.files(card, digests)
    return forger


def test_a_changed_card_is_refused_and_an_invented_interval_too(results: Results) -> None:
    assert states(checked(results, Forger(results.files))) == ["ok"]
    card = card_of(results)
    cell = card.results[0]
    assert (cell.low, cell.high) == (None, None)  # all runs returned one policy, and there are few cases
    changed = (msgspec.structs.replace(cell, low=-1e3, high=1e3), *card.results[1:])
    forger = described(results, msgspec.structs.replace(card, results=changed))
    assert set(states(checked(results, forger))) == {"failed"}


def test_a_card_of_another_version_is_a_claim(results: Results) -> None:
    forger = Forger(results.files)
    forger.json(contents.CARD, lambda card: card.update(version=cards.VERSION + 1))
    result = checked(results, forger)
    assert not result.failed
    assert states(result) == ["open"]
    assert result.claims[contents.CARD_TEXT] == ["**"]


def test_licences_of_other_versions_are_claims(results: Results) -> None:
    forger = described(results, msgspec.structs.replace(card_of(results), licences=licences(["atari"])))
    result = checked(results, forger)
    assert states(result) == ["ok"]
    assert "licences.*.licence" in result.claims[contents.CARD]
    assert b"| game ROMs |  | unknown | atari |" in forger.files[contents.CARD_TEXT]


def test_descriptions_are_valid_for_mlcroissant_without_a_network(results: Results, tmp_path: Path) -> None:
    folder = tmp_path / "beside"
    folder.mkdir()
    evopolicy(
        results.root,
        *("publish", "runs", "--out", str(folder / "licensed.evp"), "--local", "--state", "st"),
        *("--licence", "CC-BY-4.0", "--card", str(folder)),
        code=0,
    )
    unpacked = tmp_path / "unpacked"
    for name, data in results.read_file(str(folder / "licensed.evp")).items():
        (unpacked / name).parent.mkdir(parents=True, exist_ok=True)
        (unpacked / name).write_bytes(data)
    assert (folder / contents.CARD).read_bytes() == (unpacked / contents.CARD).read_bytes()
    card = msgspec.json.decode((folder / contents.CARD).read_bytes(), type=cards.Card)
    for place in (folder, unpacked):
        errors, warnings, records, limits = validated(place / contents.CROISSANT, tmp_path)
        assert (errors, warnings) == ([], [])
        assert [each["runs/score"] for each in records] == [each.score for each in card.runs]
        assert tuple(limits) == card.limits
    (unpacked / contents.CARD).write_bytes(b"{}")
    (folder / contents.CROISSANT).write_text('{"@type": "sc:Dataset"}')
    with pytest.raises(AssertionError):
        validated(folder / contents.CROISSANT, tmp_path)
