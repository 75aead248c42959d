"""Learns from trajectories more than returns: families of controllers that need a model of the environment."""

from __future__ import annotations

from evopolicy_gateway.agents.evolve.evolved.grids import find_grid
from evopolicy_gateway.agents.evolve.evolved.spaces import Schema, goal_keys
from evopolicy_gateway.agents.evolve.families import Family, moving_families, seeking_family
from evopolicy_gateway.agents.evolve.feedback import Step
from evopolicy_gateway.agents.evolve.plant import find_plant
from evopolicy_gateway.agents.evolve.views import ViewLog, find_views, view_logs

MAX_VIEW_LOGS = 96


class Lessons:
    """Collects trajectories while they can still teach anything."""

    def __init__(self, obs_space: Schema, action_space: Schema) -> None:
        self._spaces = obs_space, action_space
        self._wants_plant = goal_keys(obs_space)
        self._wants_views = find_grid(obs_space)[0] and action_space["type"] == "Discrete"
        self._logs: list[ViewLog] = []

    @property
    def wanted(self) -> bool:
        """Whether more trajectories can teach anything."""
        return self._wants_plant or self._wants_views

    def learn(self, episodes: list[list[Step]]) -> list[Family]:
        """Families that these and the earlier trajectories make possible; a known family may have newer settings."""
        families: list[Family] = []
        if self._wants_plant:
            plant = find_plant(*self._spaces, episodes)
            if plant is not None:
                self._wants_plant = False
                families += moving_families(plant, *self._spaces)
        if self._wants_views:
            self._logs = (self._logs + view_logs(*self._spaces, episodes))[-MAX_VIEW_LOGS:]
            views = find_views(*self._spaces, self._logs)
            if views is not None:
                families.append(seeking_family(views))
        return families
