"""The Gymnasium adapter's own rules, on small environments made for the purpose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import ConfigError, WorkerError
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import describe, make, registry
from evopolicy_worker.environments.families import box2d
from evopolicy_worker.environments.interface import fingerprint, gymnasium_adapter
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment, GymnasiumFamily


class Counter(gymnasium.Env[Any, Any]):
    """Counts its steps in a buffer that it keeps writing; `options` change its stride for good, as highway-env's do."""

    observation_space = gymnasium.spaces.Box(0, 1000, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    made = 0

    def __init__(self) -> None:
        Counter.made += 1
        self.stride = 1
        self.buffer = np.zeros(1, dtype=np.float32)
        self.closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.stride = (options or {}).get("stride", self.stride)
        self.buffer[0] = 0
        return self.buffer, {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.buffer[0] += self.stride
        info = {"seed": 1, "count": np.int64(self.buffer[0])}
        return self.buffer, np.float32(0.5), np.bool_(False), False, info

    def close(self) -> None:
        self.closed = True


class Drawn(Counter):
    """Renders, but its constructor takes no render mode, as HighwayEnv's lane-keeping-v0."""

    metadata = {"render_modes": ["rgb_array"]}

    def render(self) -> Any:
        assert self.render_mode == "rgb_array"
        return np.full((2, 2, 3), self.buffer[0], dtype=np.uint8)


class CounterFamily(GymnasiumFamily):
    def __init__(self, *, rebuilds: bool = False, wrap: int | None = None) -> None:
        self._rebuilds = rebuilds
        self._wrap = wrap

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        env: gymnasium.Env[Any, Any] = gymnasium.wrappers.OrderEnforcing(Counter())
        return gymnasium.wrappers.TimeLimit(env, self._wrap) if self._wrap else env

    def rebuilds(self, entry: Entry) -> bool:
        return self._rebuilds


ENTRY = Entry(
    id="test/counter",
    gymnasium_id="Counter-v0",
    family="toy",
    title="Counter",
    max_episode_steps=5,
    step_bytes=100,
    observation="state",
    action="discrete",
)


@pytest.fixture(autouse=True)
def _text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gymnasium_adapter, "task_text", lambda *_: "# Counter\n")
    monkeypatch.setattr(Counter, "made", 0)


def test_an_episode_without_its_own_limit_is_truncated_at_the_catalogues() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily())
    for _ in range(2):
        environment.reset(Case(seed=0))
        assert [environment.step(0).truncated for _ in range(5)] == [False] * 4 + [True]


def test_gymnasiums_shorter_limit_counts_and_is_described() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily(wrap=3))
    environment.reset(Case(seed=0))
    assert [environment.step(0).truncated for _ in range(3)] == [False, False, True]
    assert environment.description.max_episode_steps == 3


def test_an_environment_whose_constructor_takes_no_render_mode_renders() -> None:
    gymnasium.register("Drawn-v0", Drawn)
    try:
        entry = msgspec.structs.replace(ENTRY, gymnasium_id="Drawn-v0")
        environment = GymnasiumEnvironment(entry, GymnasiumFamily(), render=True)
        environment.reset(Case(seed=0))
        environment.step(0)
        assert environment.render().tolist() == np.ones((2, 2, 3)).tolist()
        with pytest.raises(TypeError, match="colour"):
            GymnasiumFamily().make(msgspec.structs.replace(entry, kwargs={"colour": 1}), render=True)
    finally:
        del gymnasium.registry["Drawn-v0"]


def test_step_values_are_plain_and_observations_are_copies() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily())
    first = environment.reset(Case(seed=0))
    step = environment.step(0)
    environment.step(0)
    assert (first.tolist(), step.obs.tolist()) == ([0.0], [1.0])
    assert [type(value) for value in step[1:4]] == [float, bool, bool]
    assert step.info == {"count": 1, "steps": 1}


def test_an_environment_is_kept_between_episodes() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily())
    for _ in range(3):
        environment.reset(Case(seed=0))
    assert Counter.made == 1


def test_a_family_that_rebuilds_plays_every_episode_in_a_fresh_one() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily(rebuilds=True))
    first: Any = environment.bare
    for _ in range(3):
        environment.reset(Case(seed=0))
    assert Counter.made == 3  # the one that was made to be described serves the first episode
    assert first.closed


def test_options_of_one_case_do_not_reach_the_next() -> None:
    environment = GymnasiumEnvironment(ENTRY, CounterFamily())
    environment.reset(Case(seed=0, options={"stride": 7}))
    assert environment.step(0).obs.tolist() == [7.0]
    environment.reset(Case(seed=0))
    assert environment.step(0).obs.tolist() == [1.0]


def test_an_id_that_the_catalogue_lacks_is_refused_naming_what_is_near() -> None:
    with pytest.raises(ConfigError, match="gym/acrobot"):
        make("gym/acrobat")


def test_a_family_that_is_not_installed_is_not_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    from evopolicy_worker.environments.families import minigrid

    monkeypatch.setattr(minigrid.FAMILY, "modules", ("gymnasium", "no_such_package"), raising=False)
    assert not [env_id for env_id in registry.offered() if "MiniGrid" in env_id]
    with pytest.raises(WorkerError, match=r"\.\[worker\]"):
        make("gymnasium/MiniGrid-FourRooms-v0")


def test_every_shipped_environment_has_an_adapter_and_is_offered() -> None:
    core16 = catalogue.suites()["core16"].environments
    assert set(core16) <= set(registry.offered()) <= set(catalogue.entries())
    assert not any(registry.missing(env_id) for env_id in core16)
    assert "environment 'gym/none' is not installed" in registry.missing("gym/none")
    with pytest.raises(ConfigError) as told:
        registry.check_played(["toy/line", "vizdoom/VizdoomBasic-v1"])
    start = "environment 'vizdoom/VizdoomBasic-v1' is not installed; near: gymnasium/Viz"
    assert str(told.value).startswith(start)
    assert str(told.value).count("vizdoom/VizdoomBasic-v1") == 1


def test_an_environment_that_does_not_repeat_itself_is_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    assert make("gym/acrobot").description.deterministic
    monkeypatch.setattr(gymnasium.spec("Acrobot-v1"), "nondeterministic", True)
    assert not make("gym/acrobot").description.deterministic


def test_the_fingerprint_of_an_environment_is_of_its_own_adapter_and_packages() -> None:
    acrobot, walker, line = (describe(env) for env in ("gym/acrobot", "gym/bipedal", "toy/line"))
    assert set(acrobot.packages) == {"numpy", "gymnasium"}
    assert set(walker.packages) == {"numpy", "gymnasium", "box2d", "pygame-ce"}
    assert set(line.packages) == {"numpy"}
    assert len({each.adapter for each in (acrobot, walker, line)}) == 3
    # Accelerations are part of an adapter: these two have none.
    assert describe("gymnasium/CartPole-v1").adapter == describe("gym/continuouscar").adapter
    assert all(each.adapter.startswith("1.1+") for each in (acrobot, walker, line))


def test_only_what_plays_an_environment_is_in_its_adapters_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    original = Path.read_bytes

    def noted(path: Path) -> bytes:
        read.append(path.name)
        return original(path)

    monkeypatch.setattr(Path, "read_bytes", noted)
    fingerprint._digest.cache_clear()
    fingerprint.adapter(type(box2d.FAMILY), 1, "CarRacing-v3")
    plays = {"box2d.py", "loop.py", "policy_server.py", "car_racing_road.py", "gymnasium_adapter.py"}
    assert plays <= set(read)
    assert not {"mujoco.py", "registry.py", "highway_lanes.py", "table.py"} & set(read)
