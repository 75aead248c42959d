"""Agents of the published protocol, unchanged, through a real cluster: with the published profile, and what a few of
them meet without it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import NamedTuple

import published_agents as agents
import pytest
from commands import command, record_in, toy_cluster
from published_checker import check_run

from evopolicy_common.records.run_record import RunRecord

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]


class Agent(NamedTuple):
    """A program, and what its run comes to."""

    code: str
    status: str
    closed_reason: str
    used: int
    settings: str = ""
    """Lines of its `[agents.run]`."""


BUDGET = 4
DONE = ("completed", "budget_spent", BUDGET)
SOON_SILENT = "agent_silence_s = 3.0"

PUBLISHED = {
    "variables": Agent(agents.VARIABLES, *DONE),
    "turns": Agent(agents.TURNS, *DONE),
    "bare": Agent(agents.BARE, *DONE),
    "requests": Agent(agents.REQUESTS, *DONE),
    "floods": Agent(agents.FLOODS, *DONE),
    "fails": Agent(agents.FAILS, *DONE),
    "stops early": Agent(agents.EARLY_STOP, "error", "agent_stopped", 1),
    "exits early": Agent(agents.EARLY_EXIT, "error", "agent_stopped", 1),
    "says nothing": Agent(agents.SAYS_NOTHING, "error", "silent", 1, SOON_SILENT),
    "dies": Agent(agents.DIES, "error", "agent_failed", 1),
}
"""With the profile."""

OWN = {
    "own variables": Agent(agents.VARIABLES, *DONE),
    "own stops early": Agent(agents.EARLY_STOP, "completed", "agent_stopped", 1),
    "own says nothing": Agent(agents.SAYS_NOTHING, "completed", "silent", 1, SOON_SILENT),
    "own ids": Agent(agents.NOT_PUBLISHED_IDS, "no_ok_submit", "agent_stopped", 0),
}
"""The same without it."""


def published_tree(root: Path, n_train: int = 1024) -> Path:
    """Case files in the form and number of the published ones, with seeds of our own."""
    folder = root / "toy" / "line"
    folder.mkdir(parents=True)
    seeds = iter(range(10**6))
    for split, n in (("train", n_train), ("valid", 64), ("heldout", 256)):
        cases = [{"seed": next(seeds)} for _ in range(n)]
        document = {"env": "toy/line", "split": split, "cases": cases}
        (folder / f"{split}.json").write_text(json.dumps(document))
    return root


def suite_of(folder: Path, table: dict[str, Agent], counts: str) -> Path:
    """A suite's file with these agents; `counts`: lines with the numbers of hidden cases."""
    text = f"""
name = "t"
environments = ["toy/line"]
[defaults]
budget = {BUDGET}
{counts}
[parallel]
machine = 4
"""
    for name, agent in table.items():
        program = folder / f"{name.replace(' ', '_')}.py"
        program.write_text(agents.COMMON + agent.code)
        text += f'[[agents]]\nname = "{name}"\nagent = "command:{sys.executable} {program}"\n'
        text += f"[agents.run]\n{agent.settings}\n"
    path = folder / "suite.toml"
    path.write_text(text)
    return path


Played = dict[str, tuple[Path, RunRecord]]


def play(root: Path, table: dict[str, Agent], data: Path, *more: str) -> Played:
    """The run directories of a sweep over these agents, by name, and its exit code as a run of its own."""
    folder = root / "sweep"
    folder.mkdir()
    # The published profile fixes them.
    file = suite_of(folder, table, "" if more else "validation = 2\nheldout = 2")
    # The rule is not under test, and would have each run's scoring wait for all other agents.
    with toy_cluster(root, "--data", str(data), "--hidden-isolation", "off") as operator:
        arguments = [
            "suite",
            str(file),
            "--credentials",
            str(operator),
            "--runs",
            str(folder / "runs"),
            *more,
        ]
        with command(folder, *arguments) as sweep:
            code, out, err = sweep.finish()
    assert code == 1 + 3 * (not more), out + err
    found = {name: next(folder.glob(f"runs/{name.replace(' ', '?')}/toy_line/*")) for name in table}
    return {name: (path, record_in(path)) for name, path in found.items()}


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Played:
    root = tmp_path_factory.mktemp("p")
    return play(root, PUBLISHED, published_tree(root / "data"), "--profile", "published")


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Played:
    root = tmp_path_factory.mktemp("o")
    return play(root, OWN, published_tree(root / "data", 64))


def check(played: Played, name: str, table: dict[str, Agent]) -> None:
    folder, record = played[name]
    log = (folder / "logs" / "agent.jsonl").read_text()
    outcome = record.outcome
    assert (outcome.status, outcome.closed_reason, outcome.budget_used) == table[name][1:4], log[-2000:]
    assert "Traceback" not in log, log[-2000:]


@pytest.mark.parametrize("name", PUBLISHED)
def test_an_agent_of_the_published_protocol_comes_to_what_it_would_there(
    published: Played, name: str
) -> None:
    check(published, name, PUBLISHED)


def test_run_directories_of_the_profile_pass_the_published_checker(published: Played) -> None:
    for folder, _ in published.values():
        assert check_run(folder) == [], folder


def test_runs_of_the_profile_are_stamped_and_marked_as_public(published: Played) -> None:
    for _, record in published.values():
        dimensions = record.experiment_dimensions
        assert (dimensions.profile, dimensions.finish, dimensions.policy_scope) == (
            "published",
            "budget",
            "submit",
        )
        assert (dimensions.observations, dimensions.simulation) == ("lists", "forbidden")
        assert (dimensions.step_limit, dimensions.n_train) == ("published", 1024)
        assert record.versions.data_secret is False


def test_only_a_policy_that_never_fails_is_eligible(published: Played) -> None:
    _, record = published["fails"]
    assert record.experiment_dimensions.failed_episodes == "end-submit"
    assert (list(record.outcome.val_scores or {}), record.outcome.best_submit_index) == (["2"], 2)
    assert record.outcome.quarantined_submits == (1,)


def test_one_policy_plays_a_submit_on_lists_and_unreadable_is_zero(published: Played) -> None:
    folder, _ = published["variables"]
    episodes = sorted((folder / "workspace/feedback/submit_000/episodes").iterdir())
    outputs = [(episode / "stdout.txt").read_text() for episode in episodes]
    assert outputs == [f"episode {n} of this Policy\n" for n in (1, 2, 3)]
    rows = [json.loads(line) for line in (episodes[1] / "trajectory.jsonl").read_text().splitlines()]
    unread = [row for row in rows if row["action"] is None]
    assert all(row["info"]["action_invalid"] and row["info"]["reward_effort"] == 0.0 for row in unread)
    assert json.loads((folder / "workspace/answer.json").read_text())["policy_failures"] == 0


def test_a_silent_agent_is_named_with_what_counts(published: Played) -> None:
    _, record = published["says nothing"]
    assert record.agent.settings["silence_limit_s"] == 3.0
    assert record.outcome.error is not None
    assert "silent" in record.outcome.error


@pytest.mark.parametrize("name", OWN)
def test_a_published_agent_without_the_profile_meets_our_choices(own: Played, name: str) -> None:
    check(own, name, OWN)


def test_a_policy_that_expects_lists_is_told_loudly_that_they_are_arrays(own: Played) -> None:
    answer = json.loads((own["own variables"][0] / "workspace/answer.json").read_text())
    assert (answer["status"], answer["policy_failures"]) == ("ok", 3)
    assert "ALL 3 episodes" in answer["warning"]
    assert "arrive as numpy arrays" in answer["warning"]
