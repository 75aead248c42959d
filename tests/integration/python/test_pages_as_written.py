"""The pages about other tools and about schemas, executed as they stand."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest
from commands import toy_cluster
from invented.policies import Version
from invented.run_dirs import write_run
from stages.cli_stage import FAKES
from stages.model_api import SUBMIT, ModelApi, Step

from evopolicy_common.records.run_record import decode_run_record

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]

DOCS = Path(__file__).parents[3] / "docs"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SUITE = """
name = "smoke"
environments = ["toy/line"]
[defaults]
budget = 4
validation = 1
heldout = 1
[[agents]]
name = "evolve"
agent = "evolve"
"""


def blocks(page: str, language: str) -> list[str]:
    return [code for found, code in FENCE.findall((DOCS / page).read_text()) if found == language]


def bash(code: str, folder: Path, fails: int = 0, **more: str) -> str:
    own = {
        "XDG_STATE_HOME": str(folder / "state"),
        "WANDB_MODE": "offline",
        "MLFLOW_DISABLE_TELEMETRY": "true",
    }
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", code],
        cwd=folder,
        env=os.environ | own | {"PATH": path} | more,
        capture_output=True,
        text=True,
        check=False,
        timeout=500,
    )
    assert done.returncode == fails, (code, done.stdout, done.stderr)
    return done.stderr if fails else done.stdout


def test_the_page_about_other_tools_does_what_it_says(tmp_path: Path) -> None:
    versions = [Version({"policy.py": "x = 1"}, (1.0,), 0.5, says="I begin.")]
    run = write_run(tmp_path / "runs", versions, entry="evolve")
    episode = run / "workspace/feedback/submit_000/episodes/ep_000"
    episode.mkdir(parents=True)
    row = {
        "t": 0,
        "obs": [1.0],
        "action": 1,
        "reward": 1.0,
        "terminated": True,
        "truncated": False,
        "info": {},
    }
    (episode / "trajectory.jsonl").write_text(json.dumps(row) + "\n")

    at_once, live = blocks("how-to/export.md", "sh")
    wanted = {word for line in at_once.splitlines() for word in re.findall(r"--to (\w+)", line)}
    assert wanted == {"csv", "parquet", "tensorboard", "mlflow", "wandb", "minari", "atif", "inspect"}
    bash(at_once, tmp_path)
    (tmp_path / "tables/runs.csv").unlink()
    for made in ("tables/runs.parquet", "events", "mlflow.db", "wandb", "datasets", "trajectories", "logs"):
        assert (tmp_path / made).exists(), made
    (reads,) = blocks("how-to/export.md", "python")
    check = f"python - <<'END'\n{reads}\nassert dataset.total_episodes == 1\nEND"
    bash(check, tmp_path, MINARI_DATASETS_PATH="datasets")
    # This suite file replaces the shipped one, which plays sixteen environments.
    (tmp_path / "smoke.toml").write_text(SUITE)
    assert "evolve/toy_line/smoke-0" in bash(f"{live}\nwait", tmp_path)


def plain(text: str) -> str:
    """The text without its numbers and widths."""
    return re.sub(r"-?\d[\d.]*\*?", "N", re.sub(r" +", " ", text))


def test_the_tutorial_on_an_environment_of_ones_own_prints_its_lines(tmp_path: Path) -> None:
    page = "how-to/environment-tutorial.md"
    for code in [*blocks(page, "python"), *blocks(page, "toml")]:
        path = tmp_path / code.splitlines()[0].removeprefix("# ")
        path.parent.mkdir(exist_ok=True)
        path.write_text(code)
    refused, *works = blocks(page, "bash")
    error, table, checked, runs, _model = blocks(page, "")
    assert error in bash(refused, tmp_path, fails=1)
    shown = bash("\n".join(["export PYTHONPATH=$PWD", *works]), tmp_path)
    lines = [*table.splitlines()[:6], *checked.splitlines(), *runs.splitlines()]
    lines.pop(-4)  # how sure the search is to be better than random depends on the cases
    assert [line for line in lines if plain(line) not in plain(shown)] == []
    assert (tmp_path / "report/index.html").is_file()


SMALL = "--budget 2 --validation 1 --heldout 1 --exp-id"


def stand_ins(folder: Path) -> Path:
    """A folder for the PATH with CLIs under their own names, which submit when they are prompted."""
    programs = folder / "clis" / "bin"
    programs.mkdir(parents=True)
    (folder / "clis" / "lib").mkdir()  # as in an installation, whose files the jail shows
    for name, source in (("codex", "codex"), ("fake_stream.py", "fake_stream.py"), ("gemini", "acp-agent")):
        text = (FAKES / source).read_text().replace('os.environ["FAKE_STATE"]', '".fake"')
        text = text.replace('os.environ["FAKE_SCENARIO"]', '"work"')
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return programs


def test_the_page_about_coding_agents_runs_its_agents(tmp_path: Path) -> None:
    """Its commands with the shortest runs on the smallest environment. Codex and Gemini CLI are stand-ins here, the
    built-in agent is itself; `test_real_clis.py` plays the real ones."""
    pages = [
        f"how-to/{name}.md" for name in ("coding-agents", "agents-prompts", "agents-api-key", "agents-clis")
    ]
    lines = [
        line
        for page in pages
        for block in blocks(page, "")
        for line in block.replace("\\\n", " ").splitlines()
        if line.startswith(("evopolicy files texts/", "evopolicy run")) and "remote" not in line
    ]
    (endpoint,) = [one for one in blocks("how-to/agents-api-key.md", "toml") if "EXAMPLE_API_KEY" in one]
    (tmp_path / "c").mkdir()
    with toy_cluster(tmp_path / "c") as operator, ModelApi([Step(command=SUBMIT)]) as api:
        (tmp_path / "operator-me").symlink_to(operator.parent if operator.is_file() else operator)
        (tmp_path / "AGENT.toml").write_text(endpoint.replace("http://127.0.0.1:8000", api.base_url))
        own = "evopolicy run --env gym/acrobot --agent file:AGENT.toml --credentials operator-me"
        shown = {
            "PATH": f"{stand_ins(tmp_path)}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "EXAMPLE_API_KEY": "sk-stub-0123456789abcdef",
            "GEMINI_API_KEY": "stub-0123456789abcdef",
        }
        played = []
        for number, line in enumerate([*lines, own]):
            if line.startswith("evopolicy files texts/"):
                bash(line, tmp_path, **shown)
                continue
            agent = line.partition("--agent ")[2].split()[0].strip('"').partition(":")[0]
            if "llm:" in line or "examples/agents" in line:
                continue  # at the vendor's own address
            small = line.replace("gym/acrobot", "toy/line")
            bash(f"{small} {SMALL} r{number}", tmp_path, **shown)
            played.append(agent)
    assert played == ["codex", "codex", "acp", "file"]
    records = [decode_run_record(path.read_bytes()) for path in (tmp_path / "runs").glob("*/*/*/run.json")]
    facts = {(one.jail, one.outcome.status, one.outcome.budget_used) for one in records}
    assert facts == {("bwrap", "completed", 2)}
    assert sorted(one.agent.harness for one in records) == ["acp", "codex", "codex", "llm"]
    assert sum(bool(one.agent.prompts) and bool(one.experiment_dimensions.agents_md) for one in records) == 1


def test_the_documented_schema_accepts_the_documented_suite_file(tmp_path: Path) -> None:
    pages = ("how-to/sweeps.md", "reference/files.md")
    found = [
        re.findall(r"`(evopolicy files schemas/[^`]*>[^`]*)`", (DOCS / page).read_text()) for page in pages
    ]
    ((line,), (same,)) = found
    assert line == same
    bash(line, tmp_path)
    validator = jsonschema.Draft202012Validator(json.loads((tmp_path / "suite.schema.json").read_text()))
    (example,) = [block for block in blocks("how-to/sweeps.md", "toml") if "[[agents]]" in block]
    validator.validate(tomllib.loads(example))
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(tomllib.loads(example) | {"environment": []})
