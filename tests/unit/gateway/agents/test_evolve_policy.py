"""The policies that `evolve` writes act in every space, alone and as a staged bundle."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stages.agent_fakes import load_policy

from evopolicy_gateway.agents.evolve.agent import stage_candidates, stage_code
from evopolicy_gateway.agents.evolve.evolved.controllers import build
from evopolicy_gateway.agents.evolve.evolved.spaces import ActionHead, Features
from evopolicy_gateway.agents.evolve.families import families_for
from evopolicy_gateway.agents.evolve.search import Candidate, Search
from evopolicy_worker.environments import compile_actions


def box(shape: list[int], low: Any = "-inf", high: Any = "inf", dtype: str = "float64") -> dict[str, Any]:
    return {"type": "Box", "shape": shape, "dtype": dtype, "low": low, "high": high}


UNIT = box([1], [-1.0], [1.0], "float32")
BOX = box([2], [-2.0, 0.0], [2.0, "inf"], "float32")
WIDE = box([40])
GRID = box([7, 7, 3], 0, 255, "uint8")
IMAGE = box([20, 24, 3], 0, 255, "uint8") | {"layout": "height_width_channels", "value_range": [0, 255]}
TEXT = {"type": "Text", "min_length": 2, "max_length": 9}
MULTI = {"type": "MultiDiscrete", "nvec": [2, 3]}
DISCRETE = {"type": "Discrete", "n": 5, "start": 2}
GOAL = {
    "type": "Dict",
    "spaces": {"achieved_goal": box([3]), "desired_goal": box([3]), "observation": box([5])},
}
BOTH = {"type": "Tuple", "spaces": [{"type": "MultiBinary", "n": 3}, MULTI]}
MIXED = {
    "type": "Dict",
    "spaces": {
        "direction": {"type": "Discrete", "n": 4, "start": 1},
        "image": GRID,
        "mission": TEXT,
        "both": BOTH,
    },
}
ACTIONS = {"box": BOX, "discrete": DISCRETE, "multi": MULTI, "binary": {"type": "MultiBinary", "n": [2, 2]}}
ACTIONS |= {"text": TEXT, "both": {"type": "Tuple", "spaces": [BOX, DISCRETE]}}
ACTIONS |= {"dict": {"type": "Dict", "spaces": {"a": MULTI, "b": BOX}}}
SPACES = ACTIONS | {"wide": WIDE, "image": IMAGE, "grid": GRID, "goal": GOAL, "mixed": MIXED}
SPACES |= {"large": {"type": "Discrete", "n": 500}}


def seen(space: dict[str, Any]) -> dict[str, Any]:
    """The space as an observation's, in which pictures have a type of their own."""
    return space | {"type": "Image"} if "layout" in space else space


def as_lists(obs: Any) -> Any:
    if isinstance(obs, dict):
        return {key: as_lists(part) for key, part in obs.items()}
    if isinstance(obs, tuple):
        return [as_lists(part) for part in obs]
    return obs.tolist() if isinstance(obs, np.ndarray) else obs


@pytest.mark.parametrize("obs_space", SPACES.values(), ids=SPACES.keys())
@pytest.mark.parametrize("action_space", ACTIONS.values(), ids=ACTIONS.keys())
def test_every_family_acts_within_the_action_space(
    obs_space: dict[str, Any], action_space: dict[str, Any]
) -> None:
    rng = np.random.default_rng(0)
    codec, observed = compile_actions(action_space), compile_actions(obs_space)
    candidates = Search(families_for(seen(obs_space), action_space), rng).opening(12)
    assert candidates
    for candidate in candidates:
        kind = candidate.family.kind
        controller = build(kind, candidate.vector, {}, seen(obs_space), action_space, rng)
        for _ in range(3):
            obs = observed.sample(rng)
            for given in (obs, as_lists(obs)):
                action, repaired = codec.repair(controller.act(given))
                assert not repaired, action


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES.keys())
def test_features_are_finite_of_fixed_size_and_the_same_for_lists(space: dict[str, Any]) -> None:
    features, observed = Features(seen(space)), compile_actions(space)
    rng = np.random.default_rng(1)
    for _ in range(5):
        obs = observed.sample(rng)
        vector = features.vector(obs)
        assert vector.shape == (features.size,)
        assert np.isfinite(vector).all()
        np.testing.assert_allclose(vector, features.vector(as_lists(obs)))


def test_features_of_a_goal_tell_what_is_missing() -> None:
    obs = {"achieved_goal": [1.0, 2.0, 3.0], "desired_goal": [1.5, 2.0, 2.0], "observation": [0.0] * 5}
    np.testing.assert_allclose(Features(GOAL).vector(obs)[:3], [0.5, 0.0, -1.0])


def test_nan_and_infinity_do_not_reach_the_outputs() -> None:
    vector = Features(WIDE).vector(np.full(40, np.nan))
    assert not vector.any()
    assert np.isfinite(Features(WIDE).vector(np.full(40, np.inf))).all()


def test_zero_outputs_are_the_action_nearest_to_zero() -> None:
    head = ActionHead(box([3], [-1.0, 0.5, -4.0], [1.0, 2.0, -1.0], "float32"))
    for output, expected in ((0.0, [0.0, 0.5, -1.0]), (1.0, [1.0, 2.0, -1.0]), (-1.0, [-1.0, 0.5, -4.0])):
        np.testing.assert_allclose(head.action(np.full(3, output)), expected)


def test_explorer_turns_to_what_it_has_not_tried_where_nothing_changes() -> None:
    space = {"type": "Discrete", "n": 4}
    vector = np.array([0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.1])
    explorer = build("explorer", vector, {}, BOX, space, np.random.default_rng(0))
    assert {explorer.act(np.zeros(2)) for _ in range(4)} == {0, 1, 2, 3}


def test_saliency_steers_towards_the_side_where_its_colour_is() -> None:
    vector = np.array([0.0, 1.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    controller = build("saliency", vector, {}, seen(IMAGE), UNIT, np.random.default_rng(0))
    image = np.zeros(IMAGE["shape"], dtype=np.uint8)
    image[:, 18:, 1] = 255
    assert controller.act(image)[0] > 0.1
    assert controller.act(image[:, ::-1])[0] < -0.1


def stage(system: Path, candidates: list[Candidate], schedule: list[int]) -> None:
    system.mkdir()
    stage_code(system)
    stage_candidates(system, candidates, schedule)


def constants(*values: float) -> list[Candidate]:
    family = families_for(BOX, BOX)[0]
    return [Candidate(family=family, vector=np.array([v, v])) for v in values]


def test_episode_k_plays_the_candidate_that_the_schedule_names(tmp_path: Path) -> None:
    stage(tmp_path / "system", constants(0.0, 0.5, 1.0), [2, 0, 1])
    policy = load_policy(tmp_path / "system")(BOX, BOX, {})
    played = []
    for episode in range(4):
        policy.reset(episode)
        played.append(float(policy.act(np.zeros(2))[0]))
    assert played == [2.0, 0.0, 1.0, 2.0]


def test_staged_policy_runs_without_this_package(tmp_path: Path) -> None:
    system = tmp_path / "system"
    search = Search(families_for(MIXED, DISCRETE), np.random.default_rng(0))
    stage(system, search.opening(8), list(range(8)))
    code = f"""
import sys
class Forbid:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0].startswith(("evopolicy", "gymnasium", "msgspec")):
            raise ImportError(name)
sys.meta_path.insert(0, Forbid())
sys.path.insert(0, {str(system)!r})
import json, policy
space, action_space = json.loads(sys.argv[1])
p = policy.Policy(space, action_space, {{}})
obs = {{"direction": 1, "image": [[[0] * 3] * 7] * 7, "mission": "go", "both": ([0, 1, 0], [1, 2])}}
for k in range(8):
    p.reset(k)
    assert 2 <= p.act(obs) < 7
extra = {{m.split(".")[0] for m in sys.modules}} - set(sys.stdlib_module_names)
print(sorted(m for m in extra - {{"cython_runtime"}} if not m.startswith("_")))
"""
    spaces = json.dumps([MIXED, DISCRETE])
    # Without site packages, so without an editable install, but with numpy.
    code = f"import sys; sys.path.append({str(Path(np.__file__).parent.parent)!r})\n{code}"
    command = [sys.executable, "-S", "-c", code, spaces]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "['evolved', 'numpy', 'policy']"


def test_staging_replaces_the_given_policy_and_stays_within_system(tmp_path: Path) -> None:
    system = tmp_path / "system"
    system.mkdir()
    (system / "policy.py").write_text("class Policy: ...")
    stage_code(system)
    stage_candidates(system, constants(0.0), [0])
    assert sorted(p.name for p in system.iterdir()) == ["candidates.json", "evolved", "policy.py"]
    assert "evolved.policy" in (system / "policy.py").read_text()


def test_a_choice_among_many_is_one_output() -> None:
    head = ActionHead({"type": "Discrete", "n": 1_000_000, "start": 5})
    assert head.size == 1
    chosen = [head.action(np.array([value])) for value in (-9.0, -1.0, -0.5, 0.0, 1.0, 9.0)]
    assert chosen == [5, 5, 35, 1004, 1_000_004, 1_000_004]
