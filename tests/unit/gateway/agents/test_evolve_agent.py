"""The `evolve` agent against a gateway of the test's own: it spends its budget, beats its opening, survives
refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stages.agent_fakes import FakeGateway, Play, serving

from evopolicy_gateway.agents.client import Client, ProtocolError
from evopolicy_gateway.agents.evolve import agent as evolve
from evopolicy_gateway.agents.evolve.agent import Agent

UNIT = {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1.0, -1.0], "high": [1.0, 1.0]}
CHOICE = {"type": "Discrete", "n": 3}
N_STEPS = 20


def play_point(policy: Any, case: int) -> tuple[float, list[dict[str, Any]]]:
    """A point on a plane, pushed by the action, is to come to the origin; return = minus the summed distance."""
    position = np.random.default_rng(case).uniform(-1, 1, 2)
    total, rows = 0.0, []
    for _ in range(N_STEPS):
        obs = position.astype(np.float32)
        action = np.asarray(policy.act(obs), dtype=float)
        position = np.clip(position + 0.2 * action, -1, 1)
        total -= float(np.linalg.norm(position))
        rows.append({"obs": obs.tolist(), "action": action.tolist(), "reward": total})
    return total, rows


def play_choice(policy: Any, case: int) -> tuple[float, list[dict[str, Any]]]:
    """The sign of the second component says whether the last or the first action pays."""
    rng = np.random.default_rng(case)
    total = 0.0
    for _ in range(N_STEPS):
        obs = rng.uniform(-1, 1, 2).astype(np.float32)
        total += float(policy.act(obs) == (2 if obs[1] > 0 else 0))
    return total, []


def a_run(workspace: Path, budget: int, play: Play = play_point, **options: Any) -> FakeGateway:
    (workspace / "system").mkdir(exist_ok=True)
    action_space = options.pop("action_space", UNIT)
    return FakeGateway(
        workspace=workspace, obs_space=UNIT, action_space=action_space, play=play, budget=budget, **options
    )


def run_agent(gateway: FakeGateway) -> None:
    urls = {f"{name}_url": f"{gateway.url}/{name}" for name in ("info", "task", "submit")}
    client = Client(**urls, sleep=lambda seconds: None, timeout_s=5.0)
    Agent(client, gateway.workspace).run()


def single_candidate(gateway: FakeGateway, index: int) -> bool:
    bundle = gateway.workspace / "snapshots" / f"submit_{index:03d}"
    return len(json.loads((bundle / "candidates.json").read_text())["candidates"]) == 1


@pytest.mark.parametrize(("play", "action_space"), [(play_point, UNIT), (play_choice, CHOICE)])
def test_last_checkpoints_beat_the_opening_population(
    tmp_path: Path, play: Play, action_space: dict[str, Any]
) -> None:
    with serving(a_run(tmp_path, 128, play, action_space=action_space)) as gateway:
        run_agent(gateway)
        opening = float(np.mean(gateway.submits[0]["returns"]))
        finals = [s for i, s in enumerate(gateway.submits) if single_candidate(gateway, i)]
        best = max(float(np.mean(s["returns"])) for s in finals)
        assert best > opening + 0.5 * abs(opening)


@pytest.mark.parametrize("budget", [1, 2, 3, 8, 17, 40, 128])
def test_whole_budget_is_spent_and_the_last_checkpoint_is_a_single_candidate(
    tmp_path: Path, budget: int
) -> None:
    with serving(a_run(tmp_path, budget)) as gateway:
        run_agent(gateway)
        assert gateway.left == 0
        assert single_candidate(gateway, len(gateway.submits) - 1)


def test_bounds_of_a_submit_are_kept(tmp_path: Path) -> None:
    with serving(a_run(tmp_path, 50, min_per_submit=5, max_per_submit=12)) as gateway:
        run_agent(gateway)
        assert gateway.left < 5
        assert all(5 <= s["n_episodes"] <= 12 for s in gateway.submits)


def test_a_run_with_a_single_train_case_uses_only_that(tmp_path: Path) -> None:
    with serving(a_run(tmp_path, 20, n_cases=1)) as gateway:
        run_agent(gateway)
        assert {case for s in gateway.submits for case in s["env_instances"]} == {0}


def test_submits_that_are_not_ok_are_survived(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(a_run(tmp_path, 40, statuses=["rollout_timeout", "quarantined"])) as gateway:
        run_agent(gateway)
        assert gateway.left == 0
        assert gateway.submits[-1]["status"] == "ok"
    assert "rollout_timeout" in capsys.readouterr().out


def test_agent_gives_up_when_it_is_refused_again_and_again(tmp_path: Path) -> None:
    refusal = (400, {"status": "invalid_env_instance", "error": {"message": "no such case"}})
    with serving(a_run(tmp_path, 40, script=[refusal] * 9)) as gateway:
        with pytest.raises(ProtocolError, match="no such case"):
            run_agent(gateway)
        assert not gateway.submits


def test_each_submit_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(a_run(tmp_path, 16)) as gateway:
        run_agent(gateway)
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("submit_")]
        assert len(lines) == len(gateway.submits)
        assert "0 episodes left" in lines[-1]


def test_missing_urls_are_reported_and_exit_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("INFO", "TASK", "SUBMIT"):
        monkeypatch.delenv(f"EVOPOLICYGYM_{name}_URL", raising=False)
    with pytest.raises(SystemExit, match="1"):
        evolve.main()
    assert "EVOPOLICYGYM_INFO_URL" in capsys.readouterr().err


ARM_OBS = {"type": "Box", "shape": [6], "dtype": "float64", "low": ["-inf"] * 6, "high": ["inf"] * 6}
ARM_GOAL = {"type": "Box", "shape": [3], "dtype": "float64", "low": ["-inf"] * 3, "high": ["inf"] * 3}
ARM_SPACE = {
    "type": "Dict",
    "spaces": {"observation": ARM_OBS, "achieved_goal": ARM_GOAL, "desired_goal": ARM_GOAL},
}
ARM_ACTION = {"type": "Box", "shape": [4], "dtype": "float32", "low": [-1.0] * 4, "high": [1.0] * 4}


def play_arm(policy: Any, case: int) -> tuple[float, list[dict[str, Any]]]:
    """A report space and a thing on a table; the hand carries the thing while closed on it (fourth output below 0)."""
    rng = np.random.default_rng(case)
    hand = np.array([1.0, 0.7, 0.5]) + rng.uniform(-0.02, 0.02, 3)
    thing = np.array([*(hand[:2] + rng.uniform(-0.12, 0.12, 2)), 0.42])
    goal = thing + np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.1, 0.2)])
    total, rows = 0.0, []
    for _ in range(50):
        noise = rng.normal(size=3)
        obs = {
            "observation": np.concatenate([noise[:1], hand[[1, 0, 2]], noise[1:]]),
            "achieved_goal": thing.copy(),
            "desired_goal": goal,
        }
        action = np.clip(np.asarray(policy.act(obs), dtype=float), -1, 1)
        holds = action[3] < 0 and float(np.abs(hand - thing).max()) < 0.02
        move = 0.03 * action[[2, 1, 0]]
        hand = hand + move
        thing = thing + move * holds
        reward = -float(np.linalg.norm(thing - goal) > 0.05)
        total += reward
        plain = {key: value.tolist() for key, value in obs.items()}
        rows.append({"obs": plain, "action": action.tolist(), "reward": reward})
    return total, rows


def test_a_thing_is_carried_once_trajectories_have_shown_how_the_hand_moves(tmp_path: Path) -> None:
    gateway = FakeGateway(
        workspace=tmp_path, obs_space=ARM_SPACE, action_space=ARM_ACTION, play=play_arm, budget=96
    )
    (tmp_path / "system").mkdir()
    with serving(gateway):
        run_agent(gateway)
        best = max(float(np.mean(s["returns"])) for s in gateway.submits[-8:])
        assert best > -30.0
