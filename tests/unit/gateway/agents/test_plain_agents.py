"""The agents `replay` and `random`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_gateway.agents.client import ChargedSubmit, GatewayError, RefusedSubmit
from evopolicy_gateway.agents.replay import folder_for, policies_in, shares, stage, submit_all
from evopolicy_gateway.agents.uniform import POLICY
from evopolicy_gateway.agents.uniform import submit_random as play_uniform
from evopolicy_worker.environments import compile_actions


class FakeClient:
    """The gateway's answers, without a gateway."""

    def __init__(self, budget: int = 10, least: int = 1, most: int = 10) -> None:
        self.budget, self.least, self.most = budget, least, most
        self.asked: list[list[int]] = []

    def info(self) -> dict[str, Any]:
        return {
            "env_meta": {"env": "toy/line", "n_env_instances": 3},
            "state": {"remaining_budget": self.budget},
            "min_episodes_per_submit": self.least,
            "max_episodes_per_submit": self.most,
        }

    def submit(self, env_instances: list[int]) -> ChargedSubmit | RefusedSubmit:
        self.asked.append(env_instances)
        if not env_instances:
            return RefusedSubmit(status="budget_invalid", message="none")
        return ChargedSubmit(
            name=f"submit_{len(self.asked) - 1:03d}", status="ok", summary={"mean_return": 0.0}
        )


def policy(folder: Path, text: str = "x") -> Path:
    folder.mkdir(parents=True)
    (folder / "policy.py").write_text(text)
    return folder


@given(st.integers(0, 300), st.integers(1, 40), st.integers(1, 20), st.integers(20, 300))
def test_shares_are_even_bounded_and_within_the_budget(budget: int, n: int, least: int, most: int) -> None:
    parts = shares(budget, n, least, most)
    assert sum(parts) <= budget
    assert len(parts) <= n
    assert all(least <= part <= most for part in parts)
    assert not parts or max(parts) - min(parts) <= 1
    assert parts == sorted(parts, reverse=True)
    if parts and max(parts) < most:
        assert sum(parts) == budget
    assert (parts == []) == (budget < least)


def test_policies_are_found_in_sorted_order_in_both_forms(tmp_path: Path) -> None:
    policy(tmp_path / "b")
    policy(tmp_path / "a" / "system")
    (tmp_path / "c").mkdir()
    (tmp_path / "file").write_text("")
    assert policies_in(tmp_path) == [tmp_path / "a" / "system", tmp_path / "b"]
    assert policies_in(tmp_path / "b") == [tmp_path / "b"]


def test_staging_replaces_everything_and_keeps_links_for_the_service_to_judge(tmp_path: Path) -> None:
    source = policy(tmp_path / "p")
    (source / "link").symlink_to("/etc")
    (source / "__pycache__").mkdir()
    system = policy(tmp_path / "system", "old")
    (system / "stale").mkdir()
    stage(source, system)
    assert sorted(path.name for path in system.iterdir()) == ["link", "policy.py"]
    assert os.readlink(system / "link") == "/etc"


@pytest.mark.parametrize(
    ("beside", "left_out"), [(("_meta.json",), {"_meta.json", "metrics.json"}), ((), set())]
)
def test_a_checkpoint_is_replayed_without_what_the_run_has_put_beside_it(
    beside: tuple[str, ...], left_out: set[str], tmp_path: Path
) -> None:
    given, system = tmp_path / "submit_000", tmp_path / "system"
    (given / "deep").mkdir(parents=True)
    names = {"policy.py", "metrics.json", "deep/metrics.json", *beside}
    for name in names:
        (given / name).write_text(name)
    stage(given, system)
    kept = {path.relative_to(system).as_posix() for path in system.rglob("*") if path.is_file()}
    assert kept == names - left_out


def test_replay_copies_no_set_id_bits_which_the_jail_refuses(tmp_path: Path) -> None:
    shared, system = tmp_path / "shared", tmp_path / "system"
    (shared / "deep").mkdir(parents=True)
    for name in ("policy.py", "deep/tool"):
        (shared / name).write_text(name)
    (shared / "deep" / "tool").chmod(0o4755)
    for folder in (shared, shared / "deep"):
        folder.chmod(0o2775)
    stage(shared, system)
    modes = {name: (system / name).stat().st_mode & 0o7777 for name in ("deep", "deep/tool", "policy.py")}
    assert modes["deep/tool"] == 0o755
    assert not any(mode & 0o6000 for mode in modes.values())


def test_replay_submits_each_policy_with_its_share(tmp_path: Path) -> None:
    for name in "abc":
        policy(tmp_path / "given" / name, name)
    client = FakeClient(budget=10)
    assert submit_all(client, tmp_path / "given", tmp_path) == 3  # type: ignore[arg-type]
    assert client.asked == [[0, 1, 2, 0], [0, 1, 2], [0, 1, 2]]
    assert (tmp_path / "system" / "policy.py").read_text() == "c"
    (tmp_path / "empty").mkdir()
    with pytest.raises(GatewayError, match="no policy"):
        submit_all(client, tmp_path / "empty", tmp_path)  # type: ignore[arg-type]


SPACES: list[dict[str, Any]] = [
    {"type": "Discrete", "n": 3, "start": -1},
    {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1.0, 0.5], "high": [1.0, 2.0]},
    {"type": "Box", "shape": [3], "dtype": "float64", "low": ["-inf"] * 3, "high": [0.0, 5.0, "inf"]},
    {"type": "Box", "shape": [2, 20], "dtype": "int64", "min": 1, "max": 9},
    {"type": "MultiDiscrete", "nvec": [[2], [3]], "start": [[1], [2]]},
    {"type": "MultiBinary", "n": [1, 2]},
    {"type": "Text", "min_length": 2, "max_length": 5},
    {"type": "Tuple", "spaces": [{"type": "Discrete", "n": 2}]},
    {"type": "Dict", "spaces": {"a": {"type": "MultiBinary", "n": 1}}},
]


@pytest.mark.parametrize("space", SPACES)
def test_the_uniform_policy_acts_inside_every_space_and_not_always_alike(space: dict[str, Any]) -> None:
    scope: dict[str, Any] = {}
    exec(POLICY, scope)
    player = scope["Policy"]({}, space, {})
    player.reset(0)
    actions = [player.act(None) for _ in range(60)]
    codec = compile_actions(space)
    assert not any(codec.repair(action)[1] for action in actions)
    assert len({repr(action) for action in actions}) > 1


def test_the_random_agent_spends_what_one_submit_may(tmp_path: Path) -> None:
    (tmp_path / "system").mkdir()
    client = FakeClient(budget=10, most=4)
    assert play_uniform(client, tmp_path)  # type: ignore[arg-type]
    assert client.asked == [[0, 1, 2, 0]]
    assert (tmp_path / "system" / "policy.py").read_text() == POLICY


@pytest.mark.parametrize(
    ("env", "names"),
    [
        ("gym/racing", ["", "gym_racing"]),
        ("my_env:Glider-v0", ["", "my_env:Glider-v0", "my_env_Glider-v0"]),
        ("gym/acrobot@w2", ["", "gym_acrobot", "gym_acrobot@w2"]),
        ("gymnasium/MiniGrid-Empty-v0", ["", "gymnasium_MiniGrid", "gymnasium_MiniGrid-Empty-v0"]),
    ],
)
def test_an_environment_is_played_by_the_policies_in_its_nearest_folder(
    env: str, names: list[str], tmp_path: Path
) -> None:
    for name in names:  # each is preferred to the ones before it
        (tmp_path / name).mkdir(exist_ok=True)
        assert folder_for(tmp_path, env) == tmp_path / name
