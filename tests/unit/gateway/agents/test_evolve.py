"""The `evolve` agent against a gateway of the test's own: it spends its budget, improves, refuses what it cannot read,
and continues after a kill as if it had not been killed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stages.agent_fakes import FakeGateway, Play, serving

from evopolicy_gateway.agents import evolve
from evopolicy_gateway.agents.client import Client, GatewayError
from evopolicy_gateway.agents.evolve import EvolveAgent, actions, features, observations

UNIT = {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1.0, -1.0], "high": [1.0, 1.0]}
CHOICE = {"type": "Discrete", "n": 3}
PICTURE = {"type": "Box", "shape": [96, 96, 3], "dtype": "uint8", "low": 0, "high": 255}
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
    (workspace / "system").mkdir(parents=True, exist_ok=True)
    spaces = {"obs_space": UNIT, "action_space": UNIT} | options
    return FakeGateway(workspace=workspace, play=play, budget=budget, **spaces)


def agent_of(gateway: FakeGateway, identity: str = "evolve/toy/0") -> EvolveAgent:
    urls = {f"{name}_url": f"{gateway.url}/{name}" for name in ("info", "task", "submit")}
    client = Client(**urls, sleep=lambda seconds: None, timeout_s=5.0)
    return EvolveAgent(client, gateway.workspace, identity)


def bundle_of(gateway: FakeGateway, index: int) -> dict[str, Any]:
    file = gateway.workspace / "snapshots" / f"submit_{index:03d}" / "parameters.json"
    return dict(json.loads(file.read_text()))


def is_checkpoint(gateway: FakeGateway, index: int) -> bool:
    """Whether a submit has one candidate, which then plays every episode."""
    return len(bundle_of(gateway, index)["candidates"]) == 1


@pytest.mark.parametrize(("play", "action_space"), [(play_point, UNIT), (play_choice, CHOICE)])
def test_later_checkpoints_beat_the_first_population(
    tmp_path: Path, play: Play, action_space: dict[str, Any]
) -> None:
    with serving(a_run(tmp_path, 128, play, action_space=action_space)) as gateway:
        agent_of(gateway).run()
        first = float(np.mean(gateway.submits[0]["returns"]))
        means = [s for i, s in enumerate(gateway.submits) if is_checkpoint(gateway, i)]
        assert max(float(np.mean(s["returns"])) for s in means) > first + 0.5 * abs(first)


@pytest.mark.parametrize("budget", [1, 2, 3, 8, 17, 40, 128])
def test_the_whole_budget_is_spent_and_a_checkpoint_is_last(tmp_path: Path, budget: int) -> None:
    with serving(a_run(tmp_path, budget)) as gateway:
        assert agent_of(gateway).run()
        assert gateway.left == 0
        assert is_checkpoint(gateway, len(gateway.submits) - 1)


def test_bounds_of_a_submit_are_kept(tmp_path: Path) -> None:
    with serving(a_run(tmp_path, 50, min_per_submit=5, max_per_submit=12)) as gateway:
        agent_of(gateway).run()
        assert gateway.left < 5
        assert all(5 <= s["n_episodes"] <= 12 for s in gateway.submits)


def test_a_run_with_a_single_train_case_uses_only_that(tmp_path: Path) -> None:
    with serving(a_run(tmp_path, 20, n_cases=1)) as gateway:
        agent_of(gateway).run()
        assert {case for s in gateway.submits for case in s["env_instances"]} == {0}


def test_submits_that_are_not_ok_are_survived(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(a_run(tmp_path, 40, statuses=["rollout_timeout", "cancelled"])) as gateway:
        agent_of(gateway).run()
        assert gateway.left == 0
        assert gateway.submits[-1]["status"] == "ok"
    assert "rollout_timeout" in capsys.readouterr().out


def test_a_refusal_ends_the_agent_with_its_words(tmp_path: Path) -> None:
    refusal = (400, {"status": "invalid_env_instance", "error": {"message": "no such case"}})
    with serving(a_run(tmp_path, 40, script=[refusal] * 9)) as gateway:
        with pytest.raises(GatewayError, match="no such case"):
            agent_of(gateway).run()
        assert not gateway.submits


def test_repeats_differ_and_the_same_run_has_the_same_stream(tmp_path: Path) -> None:
    found = []
    for number, identity in enumerate(["evolve/toy/0", "evolve/toy/0", "evolve/toy/1"]):
        with serving(a_run(tmp_path / str(number), 24)) as gateway:
            agent_of(gateway, identity).run()
            found.append([bundle_of(gateway, i) for i in range(len(gateway.submits))])
    assert found[0] == found[1] != found[2]


class KilledError(Exception):
    """Ends the agent as a kill does."""


@pytest.mark.parametrize("at", [1, 2, 5])
def test_a_killed_agent_continues_equal(tmp_path: Path, at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(a_run(tmp_path / "whole", 40)) as gateway:
        agent_of(gateway).run()
        whole = [bundle_of(gateway, i) for i in range(len(gateway.submits))]
    with serving(a_run(tmp_path / "killed", 40)) as gateway:
        agent, submit = agent_of(gateway), Client.submit

        def interrupted(self: Client, cases: list[int], key: str | None = None) -> Any:
            answer = submit(self, cases, key)
            if len(gateway.submits) == at:  # played, and the agent never hears of it
                raise KilledError
            return answer

        monkeypatch.setattr(Client, "submit", interrupted)
        with pytest.raises(KilledError):
            agent.run()
        monkeypatch.undo()
        agent_of(gateway).run()
        assert gateway.left == 0
        assert [bundle_of(gateway, i) for i in range(len(gateway.submits))] == whole


def test_missing_urls_are_reported_and_exit_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("INFO", "TASK", "SUBMIT"):
        monkeypatch.delenv(f"EVOPOLICYGYM_{name}_URL", raising=False)
    with pytest.raises(SystemExit, match="1"):
        evolve.main()
    assert "EVOPOLICYGYM_INFO_URL" in capsys.readouterr().err


# ---- spaces ----

SPACES: list[tuple[dict[str, Any], Any, int]] = [
    (UNIT, np.zeros(2, np.float32), 2),
    (CHOICE, 2, 3),
    ({"type": "Discrete", "n": 3, "start": -1}, -1, 3),
    ({"type": "MultiBinary", "n": [2, 2]}, np.ones((2, 2), np.int8), 4),
    ({"type": "MultiDiscrete", "nvec": [2, 5]}, np.array([1, 4]), 2),
    (PICTURE, np.zeros((96, 96, 3), np.uint8), 48),
    ({"type": "Box", "shape": [], "dtype": "float32", "low": "-inf", "high": "inf"}, np.float32(3), 1),
    ({"type": "Dict", "spaces": {"a": UNIT, "text": {"type": "Text"}}}, {"a": [0, 1], "text": "x"}, 2),
    ({"type": "Tuple", "spaces": [UNIT, CHOICE]}, ([0, 1], 2), 5),
]


@pytest.mark.parametrize(("space", "obs", "size"), SPACES, ids=lambda value: str(value)[:40])
def test_an_observation_becomes_a_vector_of_the_stated_size(
    space: dict[str, Any], obs: Any, size: int
) -> None:
    n, read = features(space)
    assert (n, read(obs).shape) == (size, (size,))


ACTIONS: list[tuple[dict[str, Any], list[float], Any]] = [
    (CHOICE, [0.0, 2.0, 1.0], 1),
    ({"type": "Discrete", "n": 2, "start": 5}, [0.0, 1.0], 6),
    ({"type": "Box", "shape": [1], "dtype": "float32", "low": [0.0], "high": [4.0]}, [0.5], [3.0]),
    ({"type": "Box", "shape": [1], "dtype": "float64", "low": ["-inf"], "high": ["inf"]}, [7.0], [1.0]),
    ({"type": "Box", "shape": [1], "dtype": "int64", "low": [0], "high": [9]}, [1.0], [9]),
    ({"type": "Box", "shape": [40], "dtype": "float32", "min": -2.0, "max": 2.0}, [-1.0] * 40, [-2.0] * 40),
    ({"type": "MultiDiscrete", "nvec": [2, 3]}, [0.0, 1.0, 9.0, 1.0, 2.0], [1, 0]),
    ({"type": "MultiBinary", "n": 3}, [1.0, -1.0, 0.5], [1, 0, 1]),
    ({"type": "Tuple", "spaces": [CHOICE, UNIT]}, [1.0, 0.0, 0.0, 1.0, -1.0], (0, [1.0, -1.0])),
]


@pytest.mark.parametrize(("space", "outputs", "action"), ACTIONS, ids=lambda value: str(value)[:40])
def test_outputs_become_an_action_of_the_space(
    space: dict[str, Any], outputs: list[float], action: Any
) -> None:
    n, act = actions(space)
    assert n == len(outputs)
    made = act(np.array(outputs))
    plain = (
        tuple(np.asarray(part).tolist() for part in made)
        if isinstance(made, tuple)
        else np.asarray(made).tolist()
    )
    assert plain == action


@pytest.mark.parametrize(("place", "kind"), [("obs_space", "Graph"), ("action_space", "Text")])
def test_a_space_that_it_cannot_read_is_refused_by_name(tmp_path: Path, place: str, kind: str) -> None:
    with serving(a_run(tmp_path, 8, **{place: {"type": kind}})) as gateway:
        with pytest.raises(ValueError, match=f"of a space of type {kind}"):
            agent_of(gateway)
        assert not gateway.submits


def test_observations_are_read_from_files_and_from_rows(tmp_path: Path) -> None:
    rows, array, arrays = (tmp_path / name for name in ("rows", "array", "arrays"))
    for folder in (rows, array, arrays):
        folder.mkdir()
    rows.joinpath("trajectory.jsonl").write_text("".join(f'{{"obs": [{t}]}}\n' for t in range(500)))
    np.save(array / "observations.npy", np.arange(3)[:, None])
    np.savez(arrays / "observations.npz", a=np.arange(3), b=np.ones((3, 2)))
    assert [obs[0] for obs in observations(rows)] == list(range(0, 500, 3))
    assert [obs.tolist() for obs in observations(array)] == [[0], [1], [2]]
    assert [(int(obs["a"]), obs["b"].tolist()) for obs in observations(arrays)][2] == (2, [1.0, 1.0])
