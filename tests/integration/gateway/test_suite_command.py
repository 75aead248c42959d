"""`evopolicy suite` as an operator uses it: real cluster, toy environments, the built-in search and the fake CLIs."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from commands import Command, command, toy_cluster, wait_until

from evopolicy_common.run_record import decode_run_record

FAKES = Path(__file__).parents[2] / "support" / "fake_clis"

SUITE = """
name = "t"
environments = ["toy/line"]
[defaults]
budget = 4
validation = 2
heldout = 2
[parallel]
machine = 3
claim_ttl_s = 3.0
[[agents]]
name = "evolve"
agent = "evolve"
[[agents]]
name = "fake codex"
[agents.config]
harness = "codex"
program = ["{python}", "{fakes}/codex"]
environment = {{ FAKE_STATE = ".fake", FAKE_SCENARIO = "{codex}" }}
backoff_s = 0.01
[agents.jail]
read = ["{fakes}"]
[[agents]]
name = "fake claude"
[agents.config]
harness = "claude-code"
program = ["{python}", "{fakes}/claude"]
environment = {{ FAKE_STATE = ".fake", FAKE_SCENARIO = "{claude}" }}
backoff_s = 0.01
[agents.jail]
read = ["{fakes}"]
"""


def write_suite(folder: Path, codex: str = "work", claude: str = "work") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "t.toml").write_text(
        SUITE.format(python=sys.executable, fakes=FAKES, codex=codex, claude=claude)
    )


def sweep(cwd: Path, *arguments: str) -> AbstractContextManager[Command]:
    """`evopolicy suite` on the file that `write_suite` wrote."""
    return command(cwd, "suite", "t.toml", *arguments)


def index_in(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "suite.json").read_text())["runs"])


def test_a_sweep_killed_twice_goes_on_where_it_was(tmp_path: Path) -> None:
    # The second turn of either fake never ends, until the third start, which works.
    write_suite(tmp_path, codex="work,endless,work", claude="work,endless,work")
    root = tmp_path / "runs" / "t"
    sessions = [root / "fake codex/toy_line/t-0/.gateway", root / "fake claude/toy_line/t-0/.gateway"]
    with sweep(tmp_path, "--local") as first:
        wait_until((root / "suite.json").exists, lambda: first.text)
        wait_until(
            lambda: index_in(root).get("evolve/toy/line/0", {}).get("state") == "completed",
            lambda: first.text,
        )
        wait_until(lambda: all(_turns(folder) == 1 for folder in sessions), lambda: first.text)
        first.kill()
    evolved = root / "evolve/toy_line/t-0/run.json"
    written = evolved.stat().st_mtime_ns
    kept = [json.loads((folder / "session.json").read_text())["session"] for folder in sessions]
    with sweep(tmp_path, "--local") as second:
        wait_until(lambda: "runs:" in second.text, lambda: second.text)
        second.kill()
    with sweep(tmp_path, "--local") as third:
        assert third.wait() == 0, third.text
        assert third.alive() == []
        text = third.text
    assert "1 kept" in text
    assert "goes on in its session" in text
    assert evolved.stat().st_mtime_ns == written
    for harness, session in zip(("codex", "claude"), kept, strict=True):
        folder = root / f"fake {harness}/toy_line/t-0"
        record = decode_run_record((folder / "run.json").read_bytes())
        assert record.outcome.status == "completed"
        assert record.outcome.budget_used == 4
        assert record.attempt == 1
        assert record.agent.harness == ("codex" if harness == "codex" else "claude-code")
        assert record.agent.tokens is not None
        starts = (folder / "workspace/.fake/starts").read_text()
        assert session in starts.splitlines()[-1]
    assert {entry["state"] for entry in index_in(root).values()} == {"completed"}
    with sweep(tmp_path, "--local", "--dry-run") as after:
        assert after.wait() == 0
        assert "3 runs: 3 kept" in after.text


def _turns(folder: Path) -> int:
    try:
        return int(json.loads((folder / "session.json").read_text())["turns"])
    except (OSError, ValueError):
        return 0


def test_a_run_without_a_session_is_begun_again_and_the_old_one_kept_aside(tmp_path: Path) -> None:
    agent = tmp_path / "agent.py"
    agent.write_text(
        "import os, json, time, urllib.request\n"
        "url = os.environ['EVOPOLICYGYM_SUBMIT_URL']\n"
        "data = json.dumps({'env_instances': [0]}).encode()\n"
        "urllib.request.urlopen(urllib.request.Request(url, data=data)).read()\n"
        "time.sleep(3600)\n"
    )
    text = (
        'name = "t"\nenvironments = ["toy/line"]\n[defaults]\nbudget = 1\nvalidation = 1\nheldout = 1\n'
        f'[[agents]]\nname = "own"\nagent = "command:{sys.executable} {agent}"\n'
    )
    (tmp_path / "t.toml").write_text(text.replace("budget = 1", "budget = 2"))
    root = tmp_path / "runs" / "t"
    feedback = root / "own/toy_line/t-0/workspace/feedback/submit_000/summary.json"
    with sweep(tmp_path, "--local") as first:
        wait_until(feedback.exists, lambda: first.text)
        first.kill()
    agent.write_text(agent.read_text().replace("3600", "0"))
    with sweep(tmp_path, "--local") as second:
        assert second.wait() == 0, second.text
        assert "begun again as a new attempt (its agent keeps no session" in second.text
    record = decode_run_record((root / "own/toy_line/t-0/run.json").read_bytes())
    assert record.attempt == 2
    aside = root / ".attempts/own/toy_line/t-0.1/workspace/feedback/submit_000/summary.json"
    assert aside.exists()


@pytest.fixture
def operator_file(tmp_path: Path) -> Iterator[Path]:
    """Credentials for a cluster of the test's own: sweeps of one name share what a coordinator knows of them."""
    with toy_cluster(tmp_path) as file:
        yield file


def test_two_hosts_share_a_sweep_and_no_run_is_played_twice(tmp_path: Path, operator_file: Path) -> None:
    hosts = [tmp_path / "one", tmp_path / "two"]
    for host in hosts:
        write_suite(host)
    arguments = ("--credentials", str(operator_file), "--parallel", "1")
    with sweep(hosts[0], *arguments) as one, sweep(hosts[1], *arguments) as two:
        assert one.wait() == 0, one.text
        assert two.wait() == 0, two.text
    records = [path for host in hosts for path in host.glob("runs/t/*/*/*/run.json")]
    assert sorted(path.parts[-4] for path in records) == ["evolve", "fake claude", "fake codex"]
    for host in hosts:
        assert {entry["state"] for entry in index_in(host / "runs" / "t").values()} == {"completed"}
        assert len(index_in(host / "runs" / "t")) == 3


def test_a_dead_hosts_runs_are_taken_over(tmp_path: Path, operator_file: Path) -> None:
    hosts = [tmp_path / "one", tmp_path / "two"]
    write_suite(hosts[0], codex="endless")
    write_suite(hosts[1], codex="endless")
    arguments = ("--credentials", str(operator_file), "--only", "fake codex/*")
    session = hosts[0] / "runs/t/fake codex/toy_line/t-0/workspace/.fake/starts"
    with sweep(hosts[0], *arguments) as one:
        wait_until(session.exists, lambda: one.text)
        one.kill()
    with sweep(hosts[1], *arguments) as two:
        wait_until(lambda: "taken over" in two.text, lambda: two.text)
        wait_until(lambda: "begins" in two.text, lambda: two.text)


def test_a_wrong_key_is_no_result_and_is_played_again_once_it_is_right(
    tmp_path: Path, operator_file: Path
) -> None:
    write_suite(tmp_path, claude="bad_key,work")
    arguments = ("--credentials", str(operator_file), "--only", "fake claude/*")
    root = tmp_path / "runs" / "t"
    with sweep(tmp_path, *arguments) as first:
        assert first.wait() == 1, first.text
        assert "401" in first.text
    (entry,) = index_in(root).values()
    assert entry["state"] == "error"
    assert "before its first submit" in entry["error"]
    # What the fake plays is told by its settings, which make another run of it.
    write_suite(tmp_path, claude="work")
    with sweep(tmp_path, *arguments, "--changed", "rerun") as second:
        assert second.wait() == 0, second.text
    (entry,) = index_in(root).values()
    assert (entry["state"], entry["attempt"]) == ("completed", 2)


def test_json_events_tell_the_plan_and_the_results(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path)
    arguments = ("--credentials", str(operator_file), "--only", "evolve/*", "--json")
    with sweep(tmp_path, *arguments) as running:
        assert running.wait() == 0, running.text
        lines = [json.loads(line) for line in running.text.splitlines() if line.startswith("{")]
    kinds = [line["event"] for line in lines]
    assert kinds[0] == "planned"
    assert kinds[1] == "started"
    assert kinds[-1] == "finished"
    assert lines[-1]["state"] == "completed"
    assert "submit" in kinds
