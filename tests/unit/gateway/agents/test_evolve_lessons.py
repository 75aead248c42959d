"""Lessons of trajectories: how a view of a world of rooms moves, and which action moves which part of a plant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evopolicy_gateway.agents.evolve.agent import Lessons
from evopolicy_gateway.agents.evolve.evolved.controllers import build
from evopolicy_gateway.agents.evolve.evolved.grids import find_grid, read_symbols
from evopolicy_gateway.agents.evolve.families import seeking_family
from evopolicy_gateway.agents.evolve.feedback import Step
from evopolicy_gateway.agents.evolve.plant import find_plant
from evopolicy_gateway.agents.evolve.views import find_views, view_logs

LEFT, RIGHT, TAKE, ADVANCE = range(4)
FLOOR, WALL, LAMP, DOOR, GOAL, OUTSIDE = 1, 2, 3, 4, 5, 0
SIZE, VIEW = 13, 5
OBS_SPACE = {
    "type": "Dict",
    "spaces": {
        "view": {"type": "Box", "shape": [VIEW, VIEW], "dtype": "uint8", "min": 0, "max": 255},
        "heading": {"type": "Discrete", "n": 4},
    },
}
ACTION_SPACE = {"type": "Discrete", "n": 4}


class Rooms:
    """Two rooms with a door between them, opened by TAKE; the goal, in the second room, ends the episode with reward
    1."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.cells = np.full((SIZE, SIZE), FLOOR)
        self.cells[[0, -1], :] = self.cells[:, [0, -1]] = WALL
        self.cells[SIZE // 2] = WALL
        self.cells[SIZE // 2, rng.integers(1, SIZE - 1)] = DOOR
        for _ in range(6):  # landmarks, else one wall looks like the next
            self.cells[tuple(rng.integers(1, SIZE // 2, 2))] = LAMP
        self.cells[tuple(rng.integers(SIZE // 2 + 2, SIZE - 2, 2))] = GOAL
        self.place = np.array([SIZE // 2 - 1, SIZE // 2])
        self.cells[tuple(self.place)] = FLOOR
        self.heading = int(rng.integers(4))

    def obs(self) -> dict[str, Any]:
        """The agent stands in the middle of the last row of its view and looks along it towards the first row."""
        padded = np.pad(self.cells, VIEW, constant_values=OUTSIDE)
        turned = np.rot90(padded, self.heading)
        row, column = self._turned(self.place + VIEW, padded.shape[0])
        seen = turned[row - VIEW + 1 : row + 1, column - VIEW // 2 : column + VIEW // 2 + 1]
        return {"view": seen.astype(np.uint8), "heading": self.heading}

    def _turned(self, place: Any, size: int) -> tuple[int, int]:
        row, column = int(place[0]), int(place[1])
        for _ in range(self.heading):
            row, column = size - 1 - column, row
        return row, column

    def step(self, action: int) -> tuple[float, bool]:
        ahead = self.place + [(-1, 0), (0, 1), (1, 0), (0, -1)][self.heading]
        symbol = self.cells[tuple(ahead)]
        if action == LEFT:
            self.heading = (self.heading - 1) % 4
        elif action == RIGHT:
            self.heading = (self.heading + 1) % 4
        elif action == TAKE and symbol == DOOR:
            self.cells[tuple(ahead)] = FLOOR
        elif action == ADVANCE and symbol in (FLOOR, GOAL):
            self.place = ahead
            return float(symbol == GOAL), bool(symbol == GOAL)
        return 0.0, False


def play(act: Any, seed: int, n_steps: int) -> list[Step]:
    world, steps = Rooms(seed), []
    for _ in range(n_steps):
        obs = world.obs()
        action = int(act(obs))
        reward, done = world.step(action)
        plain = {"view": obs["view"].tolist(), "heading": obs["heading"]}
        steps.append(Step(obs=plain, action=action, reward=reward))
        if done:
            break
    return steps


def at_random(n_episodes: int, n_steps: int) -> list[list[Step]]:
    episodes = []
    for seed in range(n_episodes):
        rng = np.random.default_rng(seed)
        episodes.append(play(lambda obs, rng=rng: rng.choice(4, p=[0.2, 0.2, 0.1, 0.5]), seed, n_steps))
    return episodes


@pytest.fixture(scope="module")
def random_play() -> list[list[Step]]:
    return at_random(25, 200)


@pytest.fixture(scope="module")
def settings(random_play: list[list[Step]]) -> dict[str, Any]:
    views = find_views(OBS_SPACE, ACTION_SPACE, view_logs(OBS_SPACE, ACTION_SPACE, random_play))
    assert views is not None
    return views


def test_moving_actions_and_the_cell_that_advancing_enters_are_identified(
    settings: dict[str, Any],
) -> None:
    assert settings["advance"] == ADVANCE
    assert settings["touch"] == (VIEW - 2) * VIEW + VIEW // 2
    assert set(settings["maps"]) == {str(LEFT), str(RIGHT), str(ADVANCE)}


def test_advancing_takes_every_symbol_from_the_row_above(settings: dict[str, Any]) -> None:
    cells = np.array(settings["maps"][str(ADVANCE)]).reshape(VIEW, VIEW)
    above = np.arange(VIEW * VIEW).reshape(VIEW, VIEW)[:-1]
    known = cells[1:] >= 0
    assert known.mean() > 0.7
    assert (cells[1:] == above)[known].mean() > 0.9


def test_symbols_that_stop_the_advance_are_told_from_others(settings: dict[str, Any]) -> None:
    assert WALL in settings["blocked"]
    assert FLOOR not in settings["blocked"]
    assert DOOR in settings["rare"]


def test_seeker_reaches_the_goal_far_more_often_than_random_play(
    settings: dict[str, Any], random_play: list[list[Step]]
) -> None:
    vector = seeking_family(settings).first[0]
    n_reached = 0
    for seed in range(100, 125):
        rng = np.random.default_rng(seed)
        seeker = build("seeker", vector, settings, OBS_SPACE, ACTION_SPACE, rng)
        n_reached += play(seeker.act, seed, 200)[-1].reward
    assert n_reached > 2 * sum(steps[-1].reward for steps in random_play)
    assert n_reached >= 15


def test_a_symbol_that_paid_becomes_a_prize_with_the_action_that_paid() -> None:
    episodes = at_random(40, 400)
    assert any(steps[-1].reward for steps in episodes)
    views = find_views(OBS_SPACE, ACTION_SPACE, view_logs(OBS_SPACE, ACTION_SPACE, episodes))
    assert views is not None
    assert views["prizes"] == [[GOAL, ADVANCE]]


def test_lessons_offer_the_seeker_once_the_view_is_understood(random_play: list[list[Step]]) -> None:
    lessons = Lessons(OBS_SPACE, ACTION_SPACE)
    assert lessons.wanted
    assert [family.name for family in lessons.learn(random_play)] == ["seeker"]


def test_grids_are_found_at_any_level_and_pictures_are_not() -> None:
    assert find_grid(OBS_SPACE) == (True, "view")
    assert find_grid(OBS_SPACE["spaces"]["view"]) == (True, None)
    assert find_grid({"type": "Image", "shape": [96, 96, 3], "dtype": "uint8"}) == (False, None)
    assert find_grid({"type": "Box", "shape": [5, 5], "dtype": "float32"}) == (False, None)


def test_cells_with_equal_channels_are_one_symbol() -> None:
    grid = np.array([[[1, 0, 2], [1, 0, 2]], [[1, 0, 3], [2, 0, 2]]])
    symbols = read_symbols(grid, None)
    assert symbols[0] == symbols[1]
    assert len(set(symbols.tolist())) == 3


def test_nothing_is_learnt_where_observations_are_stored_outside_the_rows() -> None:
    steps = [Step(obs=None, action=0, reward=0.0)] * 50
    assert Lessons(OBS_SPACE, ACTION_SPACE).learn([steps]) == []


N_OBS = 7
HAND = [5, 2, 4]
"""Where in the observation the hand's coordinates are."""
DRIVERS = [1, 3, 0]
"""The action that moves each of them."""


def box(n: int) -> dict[str, Any]:
    return {"type": "Box", "shape": [n], "dtype": "float64", "low": [-1.0] * n, "high": [1.0] * n}


def goal_space(n_axes: int) -> dict[str, Any]:
    return {
        "type": "Dict",
        "spaces": {"observation": box(N_OBS), "achieved_goal": box(n_axes), "desired_goal": box(n_axes)},
    }


def episodes(*, moved: bool = True, n_steps: int = 40) -> list[list[Step]]:
    """A hand moved by three of four outputs, a thing that slides on the floor when `moved`; the rest is noise."""
    made = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        hand, thing = np.array([1.3, 0.7, 0.5]), np.array([1.2, 0.8, 0.4])
        action = rng.uniform(-1, 1, 4)
        steps = []
        for _ in range(n_steps):
            obs = rng.normal(size=N_OBS)
            obs[HAND] = hand
            thing = thing + np.array([*rng.normal(0, 0.02, 2), 0.0]) * moved
            whole = {"observation": obs, "achieved_goal": thing, "desired_goal": np.array([1.4, 0.6, 0.6])}
            plain = {key: value.tolist() for key, value in whole.items()}
            steps.append(Step(obs=plain, action=action.tolist(), reward=-1.0))
            hand = hand + 0.03 * action[DRIVERS]
            action = np.clip(0.8 * action + 0.4 * rng.normal(size=4), -1, 1)
        made.append(steps)
    return made


@pytest.mark.parametrize("moved", [True, False])
def test_effector_and_the_outputs_that_move_it_are_identified(moved: bool) -> None:
    plant = find_plant(goal_space(3), box(4), episodes(moved=moved))
    assert plant is not None
    assert (plant["effector"], plant["outputs"], plant["lift_axis"]) == (HAND, DRIVERS, 2)
    np.testing.assert_allclose(plant["slopes"], [0.03] * 3, rtol=0.1)


STILL = [[step._replace(action=[0.0] * 4) for step in steps] for steps in episodes()]


@pytest.mark.parametrize(
    ("obs_space", "action_space", "played"),
    [
        (goal_space(6), box(4), episodes()),  # no positions in space
        (box(3), box(4), episodes()),
        (goal_space(3), {"type": "Discrete", "n": 4}, episodes()),
        (goal_space(3), box(4), episodes(n_steps=5)),
        (goal_space(3), box(4), []),
        (goal_space(3), box(4), STILL),
    ],
)
def test_other_spaces_and_too_little_play_give_no_plant(
    obs_space: Any, action_space: Any, played: Any
) -> None:
    assert find_plant(obs_space, action_space, played) is None
