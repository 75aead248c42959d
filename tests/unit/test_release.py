"""What a release rests on: workflow files, one version, and a changelog that names it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import yaml
from program_runs import run_program

import evopolicy_common

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def refusal(*files: Path) -> str:
    """What GitHub's schema, as it comes with check-jsonschema, finds wrong in workflow files; empty for nothing."""
    program = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.github-workflows"]
    done = run_program(*program, *files)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_workflow_files_follow_the_schema_of_github(tmp_path: Path) -> None:
    assert [path.stem for path in WORKFLOWS] == ["check", "docs", "release", "tests"]
    assert refusal(*WORKFLOWS) == ""
    (tmp_path / "wrong.yml").write_text(WORKFLOWS[0].read_text().replace("runs-on:", "runs_on:"))
    assert "runs_on" in refusal(tmp_path / "wrong.yml")


def test_workflows_make_targets_that_are_there() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    made = set()
    for path in WORKFLOWS:
        for job in yaml.safe_load(path.read_text())["jobs"].values():
            made |= set(job.get("strategy", {}).get("matrix", {}).get("target", ()))
            made |= {target for step in job["steps"] for target in re.findall(r"\bmake ([a-z-]+)", str(step))}
    assert {"check", "docs", "test", "test-root", "test-system", "test-families", "release"} == made
    assert made <= targets


def test_a_named_python_has_an_installation_of_its_own() -> None:
    # Make hands these on from a `make test` around this test.
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "PYTHON"))}
    for words, folder in (
        ([], ".venv"),
        ([f"PYTHON={sys.executable}"], f".venv-{sys.version_info.major}.{sys.version_info.minor}"),
    ):
        shown = subprocess.check_output(["make", "-n", "demo", *words], cwd=ROOT, text=True, env=variables)
        assert f"\n{folder}/bin/evopolicy demo\n" in f"\n{shown}"


def test_the_version_is_the_same_everywhere() -> None:
    version = evopolicy_common.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    install = (ROOT / "docs" / "how-to" / "install.md").read_text()
    assert set(re.findall(r"evopolicy-([\d.]+)-py3", install)) == {version}
    released = re.findall(r"^## \[?([\w.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[:2] == ["Unreleased", version]
