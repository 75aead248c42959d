"""An agent that swaps what is snapshot, while it is: no submit ever holds what the agent could not read itself.

Attacks, each with its defence:
- swaps `system/`, its folders or files for links, pipes or hard links while a submit is taken, also to what
  only the gateway could read: every path component is opened without following links; only regular files with
  one name are read; the submit is charged, and the agent learns the offending path.
- fills `system/` with empty folders, huge or sparse files: counted and limited before they are read.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from attacks.cheated import SECRET, Cheated

from evopolicy_common.records.policies.checkpoints import METADATA
from evopolicy_common.records.run_record import decode_run_record

AGENT = Path(__file__).with_name("programs") / "swapping_agent.py"
N_RACES = 8
REFUSED = (
    ("missing_policy", "policy.py is a symbolic link"),
    ("import_error", "deep is a symbolic link"),
    ("missing_policy", "system/ is not a folder"),
    ("import_error", "loop is a symbolic link"),
    ("import_error", "is a hard link"),
    ("import_error", "pipe is a named pipe"),
    ("import_error", "more than 5000 files and folders"),
)


class Swapped:
    def __init__(self, cheated: Cheated, *options: str) -> None:
        name = "swapped" + "".join(options)
        self.code, self.output, self.folder = cheated.play(
            f"command:{sys.executable} {AGENT}", name, "--budget", "20", *options
        )
        assert self.code == 0, self.output
        report = (self.folder / "workspace" / "report.json").read_text()
        self.verdicts: list[tuple[str, str]] = [tuple(each) for each in json.loads(report)]


@pytest.fixture(
    scope="module",
    params=[(), pytest.param(("--jail", "none"), marks=pytest.mark.system)],
    ids=["jailed", "unjailed"],
)
def swapped(request: pytest.FixtureRequest, cheated: Cheated) -> Swapped:
    return Swapped(cheated, *request.param)


def test_no_submit_holds_what_its_agent_has_not_written(swapped: Swapped) -> None:
    first = swapped.folder / "checkpoints" / "submit_000" / "policy.py"
    written = {first.read_bytes(), b"# mine\n"}
    taken = [
        path
        for path in (swapped.folder / "checkpoints").glob("*/**/*")
        if not path.is_dir() and path.name not in METADATA
    ]
    assert {path.read_bytes() for path in taken} == written
    assert not any(path.is_symlink() for path in taken)
    for path in (swapped.folder / "workspace" / "feedback").rglob("*"):
        assert path.is_dir() or SECRET.encode() not in path.read_bytes(), path


def test_links_pipes_and_oversized_files_are_charged_and_named(swapped: Swapped) -> None:
    honest, raced, spoiled = (
        swapped.verdicts[0],
        swapped.verdicts[1 : 1 + N_RACES],
        swapped.verdicts[1 + N_RACES : -1],
    )
    assert honest[0] == swapped.verdicts[-1][0] == "ok"
    assert {status for status, _ in raced} <= {"ok", "missing_policy", "import_error"}
    assert [status for status, _ in spoiled] == [status for status, _ in REFUSED]
    for (_, verdict), (_, named) in zip(spoiled, REFUSED, strict=True):
        assert named in verdict
        assert str(swapped.folder) not in verdict
    record = decode_run_record((swapped.folder / "run.json").read_bytes())
    assert (record.outcome.status, record.outcome.budget_used) == ("completed", len(swapped.verdicts))
