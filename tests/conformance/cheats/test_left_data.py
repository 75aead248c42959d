"""A policy that leaves data for its agent outside the protocol, or for its own next episode: nobody finds any of it.

What it prints in train episodes is in the feedback, as the protocol has it: that is how these tests know what it tried.

Attacks, each with its defence:
- leaves files, names, or sockets for its agent: its own file system, network, and process namespace, deleted
  after the episode.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from attacks.cheated import Cheated

from evopolicy_common.records.run_record import decode_run_record

PROGRAMS = Path(__file__).with_name("programs")
N_TRAIN = 3


class Left:
    def __init__(self, cheated: Cheated) -> None:
        policy = PROGRAMS / "leaving_policy.py"
        words = f"command:{sys.executable} {PROGRAMS / 'listening_agent.py'} {policy}"
        # Without a jail the agent and what plays its policy share the machine's folders, ports and names.
        code, output, self.folder = cheated.play(words, "left", "--jail", "none")
        assert code == 0, output
        self.report: dict[str, Any] = json.loads((self.folder / "workspace" / "report.json").read_text())


@pytest.fixture(scope="module")
def left(cheated: Cheated) -> Left:
    return Left(cheated)


def test_the_policy_left_something_in_every_train_episode(left: Left) -> None:
    assert len(left.report["reports"]) == N_TRAIN
    assert all(report["left"] for report in left.report["reports"])


def test_its_next_episode_finds_nothing(left: Left) -> None:
    """Attack: leaves something for its own next episode. Defence: a file system that is deleted after the
    episode; a new process for each episode."""
    assert [report["before"] for report in left.report["reports"]] == [[]] * N_TRAIN


def test_its_agent_finds_nothing_and_is_not_called(left: Left) -> None:
    assert left.report["files"] == []
    assert left.report["called"] == []
    assert [report["reached"] for report in left.report["reports"]] == [[]] * N_TRAIN


def test_what_it_says_in_hidden_episodes_is_kept_nowhere_in_the_run(left: Left) -> None:
    """Attack: prints in hidden episodes. Defence: hidden episodes record actions and rewards only, and
    nothing leaves before the run is over."""
    marks = {report["mark"].encode() for report in left.report["reports"]}
    assert len(marks) == N_TRAIN
    for path in left.folder.rglob("*"):
        if path.is_file():
            found = [part.partition(b"-of-an-episode")[0] for part in path.read_bytes().split(b"mark-")[1:]]
            hexadecimal = [b"mark-" + word + b"-of-an-episode" for word in found if word.isalnum()]
            assert set(hexadecimal) <= marks, path
    outcome = decode_run_record((left.folder / "run.json").read_bytes()).outcome
    assert (outcome.status, outcome.budget_used, len(outcome.heldout_returns)) == ("completed", N_TRAIN, 2)
