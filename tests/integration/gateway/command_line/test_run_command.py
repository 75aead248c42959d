"""`evopolicy run` on a cluster that is up: whole runs on the toy environments, by agents that do well, badly and
nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import Plays, agent, command, ended, record_in, run_arguments, run_dir
from waiting import wait_until


def test_a_prompted_agent_gets_turns_until_it_stops(ran: Plays) -> None:
    code = """
for line in sys.stdin:
    prompt = json.loads(line)
    answer = submit([prompt["turn"]])
    print("a line of its own")
    print(json.dumps({"turn": prompt["turn"], "text": answer["status"], "stop": prompt["turn"] == 1}), flush=True)
"""
    played = ran(code)
    record = played.record
    assert record.outcome.closed_reason == "agent_stopped"
    assert record.outcome.budget_used == 2
    assert record.agent.turns == 2
    assert "agent stopped" in played.out
    lines = [json.loads(line) for line in (played.folder / "logs/agent.jsonl").read_text().splitlines()]
    assert [line["turn"] for line in lines if line.get("type") == "prompt"] == [0, 1]
    assert {"type": "stdout", "text": "a line of its own"} in lines
    assert "4 episodes" not in lines[0]["message"]
    assert "5 episodes of the budget are left" in next(
        line["message"] for line in lines if line.get("turn") == 1 and "message" in line
    )


def test_an_agent_that_outstays_its_budget_and_ignores_requests_is_ended(ran: Plays) -> None:
    code = """
import signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
submit([0, 1, 2, 3, 4, 5])
time.sleep(1000)
"""
    outcome = ran(code).record.outcome
    assert (outcome.closed_reason, outcome.budget_used) == ("budget_spent", 6)


def test_an_agent_that_does_nothing_is_ended_by_its_wall_limit(ran: Plays) -> None:
    played = ran("submit([0, 1])\ntime.sleep(1000)", "--agent-wall-s", "2")
    outcome = played.record.outcome
    assert (outcome.closed_reason, outcome.budget_used, outcome.status) == ("wall_limit", 2, "completed")


BAD_INPUT = """
from pathlib import Path
system, policy = Path("system"), Path("system/policy.py")
good = policy.read_text()
log = []

def case(name, env_instances=(0,)):
    answer = submit(env_instances if isinstance(env_instances, str) else list(env_instances))
    info = json.load(urllib.request.urlopen(os.environ["EVOPOLICYGYM_INFO_URL"]))
    errors = Path(answer.get("feedback", "-"), "errors.txt")
    log.append([name, answer.get("status"), info["state"]["remaining_budget"],
                json.loads(errors.read_text())["message"] if errors.exists() else answer.get("error", {}).get("message")])

case("ids out of range", [64])
case("backwards", "3-1")
case("empty", [])
policy.unlink(); case("missing policy")
policy.symlink_to("/etc/passwd"); case("policy is a link"); policy.unlink()
policy.write_text(good)
(system / "link").symlink_to("/etc"); case("link beside"); (system / "link").unlink()
with open(system / "big", "wb") as big: big.truncate(2 << 30)
case("two gigabytes"); (system / "big").unlink()
policy.write_text("class Policy(:\\n"); case("syntax error")
policy.write_text("import gymnasium\\nclass Policy: ...\\n"); case("simulator")
policy.write_text("class Other: ...\\n"); case("no class")
policy.write_text(good.replace("self.action =", "raise ValueError('in init')\\n        self.action =")); case("init raises")
policy.write_text(good.replace("return self.action", "return {'no': [object]}")); case("nonsense action")
policy.write_text(good.replace("return self.action", "while True: pass")); case("never returns")
policy.write_text(good.replace("return self.action", "raise RuntimeError('at once')")); case("act raises")
Path("log.json").write_text(json.dumps(log))
"""  # noqa: E501


def test_bad_input_gets_its_verdict_and_a_message_that_helps(ran: Plays) -> None:
    played = ran(BAD_INPUT, "--budget", "20", "--limit", "act_wall_s=1")
    folder = played.folder
    log = {
        name: (status, remaining, message)
        for name, status, remaining, message in json.loads((folder / "workspace" / "log.json").read_text())
    }
    expected = {
        "ids out of range": ("invalid_env_instance", 20, "0 to 63"),
        "backwards": ("invalid_env_instance", 20, "'1-3'"),
        "empty": ("budget_invalid", 20, "0 episodes"),
        "missing policy": ("missing_policy", 19, "policy.py"),
        "policy is a link": ("missing_policy", 18, "symbolic link"),
        "link beside": ("import_error", 17, "link is a symbolic link"),
        "two gigabytes": ("import_error", 16, "2,147,483,648"),
        "syntax error": ("import_error", 15, "invalid syntax"),
        "simulator": ("denied_import", 14, "gymnasium"),
        "no class": ("import_error", 13, "Policy"),
        "init raises": ("init_error", 12, "in init"),
        "nonsense action": ("ok", 11, None),
        "never returns": ("ok", 10, None),
        "act raises": ("ok", 9, None),
    }
    for name, (status, remaining, text) in expected.items():
        assert log[name][:2] == (status, remaining), (name, log[name])
        if text is not None:
            assert text in log[name][2], (name, log[name])
    feedback = folder / "workspace" / "feedback"
    categories = {}
    for index, name in ((8, "nonsense action"), (9, "never returns"), (10, "act raises")):
        errors = (feedback / f"submit_{index:03d}").glob("episodes/*/error.txt")
        categories[name] = [json.loads(error.read_text())["category"] for error in errors]
    assert categories == {
        "nonsense action": [],
        "never returns": ["act_timeout"],
        "act raises": ["act_error"],
    }
    rows = (feedback / "submit_008/episodes").glob("*/trajectory.jsonl")
    assert all(
        json.loads(line)["info"]["action_invalid"] for path in rows for line in path.read_text().splitlines()
    )
    record = played.record
    assert [one.status for one in record.rejected_submits] == ["invalid_env_instance"] * 2 + [
        "budget_invalid"
    ]
    assert set(record.outcome.val_scores) == {"8", "9", "10"}


def test_without_an_ok_submit_the_exit_code_says_so(ran: Plays) -> None:
    code = "open('system/policy.py', 'w').write('1 / 0')\nsubmit([0, 1])"
    played = ran(code, ends=3)
    outcome = played.record.outcome
    assert (outcome.status, outcome.final_score, outcome.best_submit_index) == ("no_ok_submit", 0.0, None)
    assert outcome.budget_used == 2
    assert "no working submit" in played.out


@pytest.mark.system
def test_a_run_of_that_name_is_refused_and_replaced_only_on_demand(ran: Plays) -> None:
    file = ran("", ends=3).folder / "run.json"
    before = file.read_bytes()
    refused = ran("", ends=2)
    assert len(refused.err.strip().splitlines()) == 1
    assert "--overwrite" in refused.err
    assert file.read_bytes() == before
    assert ran("", "--overwrite", ends=3)
    assert file.read_bytes() != before


@pytest.mark.system
def test_a_run_that_is_played_is_nobody_elses_to_replace(operator_file: Path, tmp_path: Path) -> None:
    code = "submit([0])\nopen('here', 'w')\nwhile not os.path.exists('go'): time.sleep(0.05)\nsubmit([1])\n"
    arguments = run_arguments(operator_file, agent(tmp_path, code))
    with command(tmp_path, *arguments) as first:
        wait_until(lambda: [*tmp_path.glob("runs/*/toy_line/t/workspace/here")], lambda: first.text)
        for more in (["--overwrite"], ["--resume"], []):
            _, err = ended(tmp_path, *arguments, *more, ends=2)
            if more:
                assert f"process {first.process.pid}" in err
                assert len(err.splitlines()) == 1
        workspace = run_dir(tmp_path) / "workspace"
        (workspace / "go").touch()
        assert first.wait() == 0, first.text
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.status, outcome.budget_used) == ("completed", 2)
    assert [path.name for path in run_dir(tmp_path).parent.iterdir()] == ["t"]


def test_of_two_commands_that_overwrite_a_run_one_plays_it(operator_file: Path, tmp_path: Path) -> None:
    code = (
        "submit([0])\nopen(f'played-{os.getpid()}', 'w')\nwhile not os.path.exists('go'): time.sleep(0.05)\n"
    )
    arguments = [*run_arguments(operator_file, agent(tmp_path, code)), "--overwrite"]
    with command(tmp_path, *arguments) as one, command(tmp_path, *arguments) as two:
        wait_until(lambda: one.process.poll() is not None or two.process.poll() is not None)
        wait_until(lambda: [*tmp_path.glob("runs/*/toy_line/t/workspace/played-*")])
        (run_dir(tmp_path) / "workspace/go").touch()
        codes = sorted([one.wait(), two.wait()])
        assert codes == [0, 2], one.text + two.text
        assert "is in use" in one.text + two.text
    assert record_in(run_dir(tmp_path)).outcome.status == "completed"
    assert len([*(run_dir(tmp_path) / "workspace").glob("played-*")]) == 1


def test_an_agent_failing_after_its_submits_has_its_own_exit_code(ran: Plays) -> None:
    played = ran("submit([0])\nsys.exit(7)", ends=4)
    assert "agent failed" in played.out
    assert played.record.outcome.status == "completed"


@pytest.mark.system
def test_other_texts_and_less_feedback_are_recorded(ran: Plays, operator_file: Path, tmp_path: Path) -> None:
    code = """
for line in sys.stdin:
    answer = submit([0, 1])
    assert answer["summary"]["mean_return"] is not None
    print(json.dumps({"stop": True}), flush=True)
"""
    (tmp_path / "rules.md").write_text("House rules for $env.\n$standard")
    (tmp_path / "prompts.toml").write_text('first = "Begin, please."\n')
    text_options = (
        "--set",
        "feedback=scores",
        "--set",
        "agents_md=rules.md",
        "--set",
        "prompts=prompts.toml",
    )
    played = ran(code, *text_options)
    folder = played.folder
    record = played.record
    dimensions = record.experiment_dimensions
    assert dimensions.feedback == "scores"
    assert dimensions.agents_md.startswith("sha256:")
    assert record.agent.prompts.startswith("sha256:")
    assert (folder / "workspace/AGENTS.md").read_text().startswith("House rules for toy/line.\n# Improve")
    lines = [json.loads(line) for line in (folder / "logs/agent.jsonl").read_text().splitlines()]
    assert lines[0]["message"] == "Begin, please."
    feedback = folder / "workspace/feedback/submit_000"
    assert sorted(path.name for path in feedback.iterdir()) == ["episodes", "summary.json"]
    assert list((feedback / "episodes").iterdir()) == []
    ended(tmp_path, "verify", str(folder), "--credentials", str(operator_file))
