"""`evopolicy rescore` on runs that were really played: further cases, an interrupted command, and what is refused."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import agent, evopolicy, words

from evopolicy_common.messages.environment import Case
from evopolicy_common.records.rescores import RescoreRecord, read_rescore
from evopolicy_common.records.splits import SplitFile
from evopolicy_coordinator.core.contract.records import RunRow
from evopolicy_coordinator.splits import load_or_create_secret
from evopolicy_coordinator.storage.store import Reader

pytestmark = pytest.mark.system

ENV = "toy/line"
AGENT = """
POLICY = '''
import random, time
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.offset = random.random() / 10
    def reset(self, episode_index):
        pass
    def act(self, obs):
        time.sleep({})
        return {} + self.offset
'''
scale, pause = map(float, sys.argv[1:])
submit_policy(POLICY.format(pause, scale), [0, 1])
submit_policy(POLICY.format(pause, -scale), [2, 0, 1])
"""


class Played:
    """Two entries on one environment, in one state folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        program = agent(root, AGENT)
        numbers = words(f"--env {ENV} --budget 5 --validation 2 --heldout 3 --state st --exp-id e")
        for entry, scale, pause in (("mine", "0.5", "0.0"), ("slow", "0.1", "0.002")):
            own = ("--agent", f"{program} {scale} {pause}", "--entry", entry)
            evopolicy(root, "local", *numbers, *own, code=0)

    def run(self, entry: str) -> Path:
        return next(
            path.parent
            for path in self.root.glob("runs/*/*/*/run.json")
            if json.loads(path.read_text())["agent"]["entry"] == entry
        )

    def rescore(
        self, *options: str, state: str = "st", code: int | None = None
    ) -> subprocess.CompletedProcess[str]:
        return evopolicy(self.root, "rescore", *options, "--local", "--state", state, code=code)

    def begin(self, *options: str, state: str, outcomes: int) -> subprocess.Popen[str]:
        """A re-score that has played that many episodes and goes on."""
        command = (sys.executable, "-m", "evopolicy_gateway.cli", "rescore", *options)
        started = subprocess.Popen(
            [*command, "--local", "--state", state],
            cwd=self.root,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        wanted = n_outcomes(self.root / "st" / "coordinator.sqlite") + outcomes
        deadline = time.monotonic() + 120
        while n_outcomes(self.root / state / "coordinator.sqlite") < wanted:
            assert started.poll() is None, "it ended before it had played them"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return started

    def record(self, entry: str, name: str) -> RescoreRecord:
        found = read_rescore(self.run(entry), name)
        assert found is not None
        return found


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return Played(tmp_path_factory.mktemp("rescore"))


def test_checkpoints_play_further_cases_and_the_report_uses_them(played: Played) -> None:
    before = {entry: (played.run(entry) / "run.json").read_bytes() for entry in ("mine", "slow")}
    done = played.rescore("runs", "--cases", "8", "--json", code=0)
    assert len(json.loads(done.stdout)) == 2
    mine, slow = played.record("mine", "cases-8"), played.record("slow", "cases-8")
    assert before == {entry: (played.run(entry) / "run.json").read_bytes() for entry in before}
    for record, entry in ((mine, "mine"), (slow, "slow")):
        (checkpoint,) = record.checkpoints
        document = json.loads(before[entry])
        assert checkpoint.submit_index == record.selected == document["outcome"]["best_submit_index"]
        assert (len(checkpoint.returns), len(record.random_returns), record.n_cases) == (8, 8, 8)
        assert record.cases_hash != document["versions"]["cases_hashes"]["heldout"]
        assert set(checkpoint.returns).isdisjoint(document["outcome"]["heldout_returns"])
    # Runs of one environment are paired by case, the reference's actions too.
    assert (mine.cases_hash, mine.random_returns) == (slow.cases_hash, slow.random_returns)

    # A repeated command plays nothing; other checkpoints are added to the same file.
    again = played.rescore("runs", "--cases", "8", "--json")
    assert [one["episodes"] for one in json.loads(again.stdout)] == [0, 0]
    played.rescore("runs", "--cases", "8", "--all-checkpoints", code=0)
    added = played.record("mine", "cases-8")
    assert [each.submit_index for each in added.checkpoints] == [0, 1]
    assert added.checkpoint(mine.selected) == mine.checkpoints[0]

    done = evopolicy(played.root, "report", "runs", "--scores", "cases-8", "--out", "report", code=0)
    document = json.loads((played.root / "report" / "report.json").read_text())
    assert "cases-8: 8 further hidden cases, played post hoc" in document["post_hoc"]
    assert "post hoc" in document["tables"]["heldout"]["caption"]
    assert "post hoc" in (played.root / "report" / "index.html").read_text()
    shown = {run["entry"]: run["score"] for run in document["runs"]}
    assert shown["mine"] == math.fsum(mine.checkpoints[0].returns) / 8
    plain = evopolicy(played.root, "report", "runs", "--out", "plain")
    assert plain.returncode == 0, plain.stderr
    own = json.loads((played.root / "plain" / "report.json").read_text())
    assert own["post_hoc"] == ""
    assert {run["entry"]: run["score"] for run in own["runs"]} == {
        entry: json.loads(data)["outcome"]["final_score"] for entry, data in before.items()
    }


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_command_continues_where_it_stopped(played: Played, how: signal.Signals) -> None:
    # The same secret and run, hence the same cases, in two copies of the state: one is interrupted.
    name = f"cut-{how.name}"
    for state in ("whole", "cut"):
        shutil.rmtree(played.root / state, ignore_errors=True)
        shutil.copytree(played.root / "st", played.root / state)
    run = played.run("slow")
    options = (str(run), "--cases", "24", "--name", name, "--json")
    played.rescore(*options, state="whole", code=0)
    whole = played.record("slow", name)
    shutil.rmtree(run / "rescore")

    cut = played.begin(*options, state="cut", outcomes=28)
    database = played.root / "cut" / "coordinator.sqlite"
    if how == signal.SIGKILL:
        os.killpg(cut.pid, how)
    else:
        os.kill(cut.pid, how)
    assert cut.wait(60) == (130 if how == signal.SIGINT else -how)
    assert not (run / "rescore" / f"{name}.json").exists()

    played.rescore(*options, state="cut", code=0)
    # The policy draws random numbers: equal returns show equal cases and equal seeds.
    assert without_time(played.record("slow", name)) == without_time(whole)
    # Random actions and the checkpoint, no episode twice.
    assert n_outcomes(database) == n_outcomes(played.root / "st" / "coordinator.sqlite") + 2 * 24


def test_a_cancelled_re_score_ends_with_the_reason(played: Played) -> None:
    shutil.copytree(played.root / "st", played.root / "cancelled")
    run = played.run("slow")
    options = (str(run), "--cases", "300", "--name", "cancelled")
    began = played.begin(*options, state="cancelled", outcomes=304)
    with sqlite3.connect(f"file:{played.root}/cancelled/coordinator.sqlite?mode=ro", uri=True) as db:
        ((name,),) = db.execute("SELECT evaluation FROM evaluations WHERE finished = 0").fetchall()
    evopolicy(played.root, "runs", "cancel", name, "--credentials", "cancelled/credentials", code=0)
    _, output = began.communicate(timeout=60)
    assert (began.returncode, "an operator cancelled evaluation" in output) == (1, True), output


def n_outcomes(database: Path) -> int:
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as db:
        return int(db.execute("SELECT COUNT(*) FROM outcomes").fetchone()[0])


def without_time(record: RescoreRecord) -> Any:
    return msgspec.structs.replace(record, played_at="")


def test_cases_of_files_are_played_and_must_be_disjoint(played: Played) -> None:
    data = played.root / "more"
    folder = data / "toy_line"
    folder.mkdir(parents=True)
    content = SplitFile(
        env=ENV, split="heldout", cases=tuple(Case(seed=seed) for seed in range(5)), secret=True
    )
    (folder / "heldout.json").write_bytes(msgspec.json.encode(content))
    run = str(played.run("mine"))
    done = played.rescore(run, "--data", "more", code=0)
    record = played.record("mine", "more")
    assert (record.n_cases, record.cases_from, record.cases_secret) == (5, "files", True)

    taken = hidden_seeds(played)[0]
    content = SplitFile(env=ENV, split="heldout", cases=(Case(seed=1), Case(seed=taken)))
    (folder / "heldout.json").write_bytes(msgspec.json.encode(content))
    done = played.rescore(run, "--data", "more", "--name", "taken")
    assert (done.returncode, f"seed {taken}" in done.stderr) == (2, True), done.stderr
    done = played.rescore(run, "--data", "more")
    assert (done.returncode, "choose another --name" in done.stderr) == (2, True), done.stderr


def hidden_seeds(played: Played) -> list[int]:
    """Seeds of the held-out cases that both runs played."""
    reader = Reader(played.root / "st" / "coordinator.sqlite")
    row = reader.one(RunRow, run=json.loads((played.run("mine") / "run.json").read_text())["run"])
    assert row is not None
    return [case.seed for case in row.heldout]


def test_runs_that_cannot_be_rescored_are_refused_with_the_reason(played: Played, tmp_path: Path) -> None:
    run = played.run("mine")

    def refused(*options: str, state: str = "st") -> str:
        done = played.rescore(*options, state=state, code=2)
        return done.stderr

    assert "no run directory at or below" in refused("missing", "--cases", "2")
    assert "name the new cases" in refused(str(run))
    unfinished = tmp_path / "unfinished"
    shutil.copytree(run, unfinished)
    (unfinished / "run.json").unlink()
    assert "the run did not finish" in refused(str(unfinished), "--cases", "2")

    def changed(name: str, change: dict[str, Any]) -> str:
        copy = tmp_path / name
        shutil.copytree(run, copy)
        document = json.loads((copy / "run.json").read_text())
        (copy / "run.json").chmod(0o644)
        (copy / "run.json").write_text(json.dumps(document | change))
        return str(copy)

    assert "no finished run r-other" in refused(changed("other", {"run": "r-other"}), "--cases", "2")
    versions = json.loads((run / "run.json").read_text())["versions"]
    versions["fingerprint"]["numpy"] = "0.1"
    text = refused(changed("versions", {"versions": versions}), "--cases", "2")
    assert "numpy 0.1 in the run" in text
    assert "toy/none" in refused(changed("env", {"env": "toy/none"}), "--cases", "2")


def test_runs_that_the_coordinator_does_not_know_leave_the_others_rescored(
    played: Played, tmp_path: Path
) -> None:
    for name, change in (("a-strange", {"run": "r-other"}), ("mine", {}), ("unfinished", None)):
        shutil.copytree(played.run("mine"), tmp_path / name)
        path = tmp_path / name / "run.json"
        path.chmod(0o644)
        if change is None:
            path.unlink()
            continue
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
    folders = [str(tmp_path / name) for name in ("a-strange", "mine", "unfinished")]
    done = played.rescore(*folders, "--cases", "2", "--name", "some", "--json", code=3)
    assert [one["path"] for one in json.loads(done.stdout)] == [str(tmp_path / "mine/rescore/some.json")]
    said = " ".join(done.stderr.split())
    assert (
        f"not re-scored: {tmp_path / 'a-strange'}: this cluster's coordinator has no finished run r-other"
        in said
    )
    assert f"not re-scored: {tmp_path / 'unfinished'}: the run did not finish: it has no run.json" in said
    assert "1 of 3 runs are re-scored" in said


def test_a_revealed_epoch_gives_no_further_hidden_cases(played: Played) -> None:
    shutil.copytree(played.root / "st", played.root / "revealed")
    run = str(played.run("mine"))
    done = evopolicy(
        played.root, "publish", run, "--out", "mine.evp", "--local", "--state", "revealed", code=0
    )
    done = played.rescore(run, "--cases", "2", "--name", "late", state="revealed")
    assert (done.returncode, "epoch new" in done.stderr) == (2, True), done.stderr
    before = load_or_create_secret(played.root / "revealed" / "secret")
    done = subprocess.run(
        [sys.executable, "-m", "evopolicy_coordinator.cli", "epoch", "new", "--state", "revealed"],
        cwd=played.root,
        check=False,
    )
    assert done.returncode == 0
    assert load_or_create_secret(played.root / "revealed" / "secret") != before
    done = played.rescore(run, "--cases", "2", "--name", "late", state="revealed", code=0)
