"""Environments that do not ship: made from files and by module, in every space, and refused where they break their
word."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from evopolicy_common.catalogue import Entry, Wrapper
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_gateway.agents import uniform
from evopolicy_gateway.workspace.staging import constant_action
from evopolicy_worker.environments import Environment, compile_actions, define, describe, make, registry
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily, Opaque
from evopolicy_worker.environments.interface.spaces import compile_checker
from evopolicy_worker.environments.interface.trial import solved
from evopolicy_worker.episodes.frames import compile_writer
from evopolicy_worker.sandbox.inside import policy_server

PACKAGE = Path(__file__).parents[3] / "support" / "foreign_package"


@pytest.fixture(autouse=True)
def _package(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield
    registry._defined.clear()


def defined(name: str, **more: Any) -> str:
    define([Entry(**{"id": f"acme/{name}", "gymnasium_id": f"acme_envs:{name}-v0", **more})])
    return f"acme/{name}"


def test_what_gymnasium_makes_by_module_is_described_from_its_documentation_and_spaces() -> None:
    description = describe("acme_envs:Glider-v0")
    assert description.max_episode_steps == 20
    assert "A point is steered to the origin." in description.task_text
    assert "an array of shape (2,) of float32, from -10 to 10" in description.task_text
    assert "after 20 steps at the latest" in description.task_text
    assert description.definition == {"gymnasium_id": "acme_envs:Glider-v0"}
    assert "+src." in description.packages["acme_envs"]
    assert description.renders


def test_an_environment_without_a_limit_gets_the_usual_one() -> None:
    assert describe("acme_envs:Endless-v0").max_episode_steps == 1000


def test_a_definition_sets_arguments_wrappers_limit_text_and_success() -> None:
    rescaled = Wrapper(wrapper="RescaleAction", kwargs={"min_action": -2.0, "max_action": 2.0})
    more = {"kwargs": {"push": 0.9}, "wrappers": (rescaled,), "max_episode_steps": 7}
    more |= {"task": "# Fly\u202e\x07", "success": "near", "title": "G"}
    description = describe(defined("Glider", **more))
    assert (description.max_episode_steps, description.task_text) == (7, "# Fly")
    assert (description.success, description.title) == ("near", "G")
    assert description.action_space["high"] == [2.0]
    assert description.digest() != describe("acme_envs:Glider-v0").digest()
    environment = make("acme/Glider")
    environment.reset(Case(seed=1))
    assert [environment.step(np.zeros(1, "f")).truncated for _ in range(7)] == [False] * 6 + [True]


WRAPPERS = {
    "ClipActions": "wrapper 'ClipActions': no wrapper has this name; near: ClipAction",
    "no_such:Thing": "'no_such:Thing': no wrapper has this name; say a class of gymnasium.wrappers, or module:Class",
    "TransformReward": "kwargs {}: it cannot be put around the environment: TypeError",
    "broken_on_import:Thing": "its module 'broken_on_import' raised RuntimeError: half a build on import",
    "acme_envs:Grumbles": "acme/Glider, step 0: it raised LookupError: no such tile; it has to take any action",
}
BAD = {
    "nan": "environment acme/Bad, step 0, reward: it is nan; rewards have to be finite",
    "outside": "step 0, observation: element .* is 9.*, not -10.0 to 10.0; correct the environment",
    "shape": "step 0, observation: an array of shape .3,., not .2,.",
    "raise in reset": "environment acme/Bad, reset: it raised RuntimeError: no level of that seed",
    "change spaces": "environment acme/Bad, reset, observation_space: it has changed",
    "change spaces in step": "acme/Bad, step 0, action_space: it has changed; a space has to stay",
    "custom space": "observation_space: a space of type Opaque .* has no form here: known are Box",
    "bare reset": r"reset: it returned array\(.* \(ndarray\); it has to return an observation and a dict",
    "four values": r"step 0, returned values: \(array.* \(tuple\); it has to return observation, reward",
    "object reward": r"step 0, reward: it is <object .* \(object\); a reward has to be one number, or its",
    "reward of several": r"step 0, reward: it is array\(\[1., 1., 1.\]\).*be named in reward_vector",
    "ends of several": r"step 0, terminated: it is array.*it has to be true or false",
    "an end in a list": r"step 0, truncated: it is \[False\] \(list\); it has to be true or false",
    "info of several": r"step 0, info: it is \[\{'near'.* \(list\); it has to be a dict",
    "text observation": r"step 0, observation: it is 'a hill\\nto the left' \(str\), and cannot be read as",
    "no observation": r"step 0, observation: an array of shape \(\), not \(2,\)",
}
"""Environments that break their word, by how."""
MISREAD = {
    "byte": r"element \(1,\) is 300, which uint8 does not have",
    "picture": r"element \(0, 0, 0\) is 0.5, which uint8 does not have",
    "fraction": r"it is 1.7 \(float\), not an integer",
    "parts": r"\['a'\] \[0\] element \(0,\) is 0.5, which int64 does not have",
    "number": r"it is 12 \(int\), not a text",
    "letters": "a text with 'c', which is not one of its characters",
}
"""Observations that are not turned into ones of their space."""
MISREADS = "environment acme/Misread, reset, observation: {}; correct"
MADE = r"make: gymnasium.make\("
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    *(("Glider", {"wrappers": (Wrapper(wrapper=wrapper),)}, why) for wrapper, why in WRAPPERS.items()),
    *(("Bad", {"kwargs": {"how": how}}, why) for how, why in BAD.items()),
    *(("Misread", {"kwargs": {"what": what}}, MISREADS.format(why)) for what, why in MISREAD.items()),
    # What cannot be made, with the field to correct.
    (
        "Glider",
        {"kwargs": {"pushh": 1}},
        MADE + ".*raised TypeError: .*'pushh'.*correct kwargs .* of its file",
    ),
    ("Glider", {"kwargs": {"push": "hard"}}, "acme/Glider, step 0: it raised .*; it has to take any action"),
    (
        "Glider",
        {"gymnasium_id": "acme_envs:Slider-v0"},
        MADE + r"'acme_envs:Slider-v0'\) raised NameNotFound: .*correct its gymnasium_id",
    ),
    (
        "Glider",
        {"gymnasium_id": "broken_on_import:Thing-v0"},
        MADE + ".*raised RuntimeError: half a build; correct its gymnasium_id, or",
    ),
    (
        "Glider",
        {"title": "\ud800"},
        "make: its spaces and texts cannot be sent .*; let them have valid Unicode",
    ),
    (
        "Bad",
        {"kwargs": {"how": "success in words"}, "success": "near"},
        r"acme/Bad, step, info\['near'\]: it is a text; success is true or",
    ),
    (
        "Treasure",
        {"reward_vector": ("a", "b", "c")},
        "reward_vector: it names 3 elements, and the environment's rewards have 2",
    ),
]


@pytest.mark.parametrize(("name", "more", "why"), REFUSED)
def test_an_environment_is_refused_with_the_field_to_correct(
    name: str, more: dict[str, Any], why: str
) -> None:
    with pytest.raises(WorkerError, match=why):
        describe(defined(name, **more))


def test_a_modules_syntax_error_is_shown_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "unfinished.py").write_text("x = 1\ndef f(:\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(WorkerError, match=r'unfinished.py", line 2: def f\(:$'):
        describe("unfinished:Thing-v0")


def test_a_package_that_is_missing_is_named_with_what_to_install() -> None:
    with pytest.raises(WorkerError, match="no_such_pkg:X-v0 needs the package with the module 'no_such_pkg'"):
        make("no_such_pkg:X-v0")


def test_a_reward_vector_is_recorded_whole_and_counts_by_its_weights() -> None:
    description = describe("acme_envs:Treasure-v0")
    assert description.reward_weights == {"reward_0": 1.0, "reward_1": 1.0}
    name = defined("Treasure", reward_vector=("distance", "effort"), reward_weights={"effort": 0.5})
    description = describe(name)
    assert description.reward_components == ("distance", "effort")
    assert description.reward_texts["effort"] == "element of the reward vector; weight 0.5"
    environment = make(name)
    environment.reset(Case(seed=0))
    step = environment.step(np.ones(1, "f"))
    distance, effort = step.info["reward_vector"]
    assert step.info["rewards"] == {"distance": distance, "effort": effort}
    assert step.reward == distance + 0.5 * effort


def test_a_success_is_a_number_alone() -> None:
    told = [solved(each) for each in (True, 0.0, [1], [0.0], [], [1, 1], "False", {}, math.nan)]
    assert told == [True, False, True, False, None, None, None, None, False]


@pytest.fixture
def everything() -> Iterator[Environment]:
    environment = make("acme_envs:Everything-v0")
    yield environment
    environment.close()


def received(environment: Environment, obs: Any, *, as_lists: bool) -> Any:
    """The observation as the policy's process reads it from the bytes that are sent."""
    space = json.loads(json.dumps(environment.description.obs_space))
    (_, *parts), _ = compile_writer(space)(obs)
    data = b"".join(map(bytes, parts))
    _, read = policy_server.observation_reader(space, as_lists)
    return read(bytearray(data), len(data))


def same(left: Any, right: Any) -> bool:
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(np.array_equal(left, right)) and getattr(left, "dtype", None) == getattr(right, "dtype", None)


def plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


@pytest.mark.parametrize("seed", range(8))
def test_observations_of_every_space_reach_the_policy_as_they_are(everything: Environment, seed: int) -> None:
    obs = everything.reset(Case(seed=seed))
    assert compile_checker(everything.description.obs_space)(obs) == ""
    assert same(received(everything, obs, as_lists=False), obs)
    assert received(everything, obs, as_lists=True) == plain(obs)


@pytest.mark.parametrize("seed", range(8))
def test_random_actions_lie_in_their_space_and_replay_equally(everything: Environment, seed: int) -> None:
    codec, rng = everything.action_codec, np.random.default_rng(seed)
    recorder = Recorder()
    obs = everything.reset(Case(seed=seed))
    played = []
    for _ in range(4):
        action = codec.sample(rng)
        again, invalid = codec.repair(action)
        assert not invalid
        step = everything.step(again)
        assert step.info["inside"], action
        recorder.append(obs, action, step.reward, False, False, step.info)
        played.append(step)
        obs = step.obs
    rows = list(decode(recorder.finish()).rows())
    everything.reset(Case(seed=seed))
    for row, step in zip(rows, played, strict=True):
        action, invalid = codec.repair(row.action)
        assert not invalid
        assert same(everything.step(action).obs, step.obs)
        assert row.reward == 1.0


@pytest.mark.parametrize(
    "raw", [None, 3, [], {}, "x", {"items": 7, "graph": {"nodes": [[0, 0]], "edge_links": [[0, 9]]}}]
)
def test_anything_is_repaired_into_every_space(everything: Environment, raw: object) -> None:
    action, invalid = everything.action_codec.repair(raw)
    assert invalid
    everything.reset(Case(seed=0))
    assert everything.step(action).info["inside"]


def test_texts_of_a_set_of_characters_are_made_of_these() -> None:
    codec = compile_actions({"type": "Text", "min_length": 2, "max_length": 4, "characters": "ab"})
    assert codec.repair("abba") == ("abba", False)
    assert codec.repair("xaxbx") == ("ab", True)
    assert codec.repair("") == ("aa", True)
    assert set(codec.sample(np.random.default_rng(0))) <= {"a", "b"}


def test_every_space_is_described_in_words(everything: Environment) -> None:
    text = everything.description.task_text
    for part in ("`graph`", "`either`", "`items`", "any number of items", "a pair of an index and a value"):
        assert part in text


def test_agents_that_ship_act_in_every_space(everything: Environment) -> None:
    space = json.loads(json.dumps(everything.description.action_space))
    names: dict[str, Any] = {}
    exec(uniform.POLICY, names)  # as the policy's process does
    for action in (constant_action(space), names["sample"](space)):
        repaired, invalid = everything.action_codec.repair(action)
        assert not invalid
        everything.reset(Case(seed=0))
        assert everything.step(repaired).info["inside"]


def test_the_readmes_environment_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (PACKAGE.parents[2] / "README.md").read_text(encoding="utf-8")
    (source,) = [block for block in readme.split("```python\n")[1:] if block.startswith("# my_env.py\n")]
    (tmp_path / "my_env.py").write_text(source.partition("```")[0], encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    description = describe("my_env:Glider-v0")
    assert description.max_episode_steps == 50
    assert "A point is steered to the origin." in description.task_text


def test_a_family_encodes_spaces_that_are_not_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a simulator whose classes nobody can change."""

    class Invented(GymnasiumFamily):
        def encoding(self, space: Any) -> Opaque | None:
            if type(space).__name__ != "Opaque":
                return None
            return Opaque(gymnasium.spaces.Discrete(9), lambda value: len(value), lambda action: "x" * action)

    monkeypatch.setattr(registry, "family_of", lambda found: Invented())
    environment = make(defined("Bad", kwargs={"how": "custom space"}))
    assert environment.description.obs_space == {"type": "Discrete", "n": 9}
    monkeypatch.setattr(environment.bare, "reset", lambda **_: ("four", {}))  # type: ignore[attr-defined]
    assert environment.reset(Case(seed=1)) == 4
