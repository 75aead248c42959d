"""What an agent leaves in its workspace does not keep its run from being scored, nor lead anybody astray who reads
it.

Attacks, each with its defence:
- leaves objects in its workspace that disturb scoring, reports, or comparisons: a pipe in place of `system/`,
  links to other folders, deeply nested folders, a run directory, removed permissions: file types are checked
  before opening; links are not followed; depth and size are bounded; permissions are restored.
"""

from __future__ import annotations

import stat
import sys
from pathlib import Path

import pytest
from attacks.cheated import Cheated
from commands import evopolicy

from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.policies.checkpoints import METADATA
from evopolicy_common.records.run_difference import differences
from evopolicy_common.records.run_record import decode_run_record

pytestmark = pytest.mark.system

AGENT = Path(__file__).with_name("programs") / "parting_agent.py"


@pytest.mark.parametrize("how", ["as it is", "pipe", "socket", "link", "deep"])
def test_traps_that_an_agent_leaves_catch_nobody(
    cheated: Cheated, tmp_path: Path, how: str, request: pytest.FixtureRequest
) -> None:
    outside = cheated.root / f"outside {how}"
    outside.mkdir()
    (outside / "plot.png").write_bytes(b"not the agent's")
    words = f"command:{sys.executable} {AGENT} '{how}' '{outside}'"
    # The link is of use to an agent that does not see where it leads, too.
    code, output, folder = cheated.play(words, f"parting {how}".replace(" ", "-"))
    request.addfinalizer(lambda: remove_tree(folder / "workspace"))
    assert code == 0, output
    outcome = decode_run_record((folder / "run.json").read_bytes()).outcome
    assert (outcome.status, outcome.budget_used) == ("completed", 1)
    assert not (folder / ".gateway").exists()
    assert [path.name for path in outside.iterdir()] == ["plot.png"]
    workspace = folder / "workspace"
    assert stat.S_IMODE(workspace.stat().st_mode) & 0o700 == 0o700
    kinds = {stat.S_IFMT(path.lstat().st_mode) for path in workspace.glob("*")}
    assert kinds == {stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK}
    submitted = {
        path.name: path.read_bytes()
        for path in (folder / "checkpoints/submit_000").iterdir()
        if path.name not in METADATA
    }
    assert {path.name: path.read_bytes() for path in (workspace / "system").iterdir()} == submitted
    assert set(submitted) == {"policy.py", ".bashrc"}
    if how == "as it is":  # the rest of the workspace is the same in all of them
        check_readers(folder, tmp_path / "report")
    if how == "deep":
        code, output, again = cheated.play("random", folder.name, "--overwrite")
        assert (code, again) == (0, folder), output
        assert not (workspace / "d").exists()


def check_readers(folder: Path, report: Path) -> None:
    """Who reports the run, or compares it, comes to an end and shows nothing of this machine."""
    done = evopolicy(None, "report", str(folder), "--out", str(report))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "\x1b]0" not in done.stdout + done.stderr
    page = "".join(path.read_text() for path in report.rglob("*.html"))
    assert page
    assert "root:x:0" not in page
    (difference,) = differences(folder, folder)
    assert difference.startswith("workspace/huge.png: ")
    assert difference.endswith("too many to compare")
