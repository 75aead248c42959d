"""Python packages that simulate: only a worker's environment process may have them.

With one of them a policy could look ahead, and an agent could train outside its budget. The sandboxes of policies and
the jails of agents hide them.
"""

from __future__ import annotations

_NAMES = """
gymnasium gymnasium_robotics gym mujoco mujoco_py Box2D box2d minigrid highway_env pygame ale_py miniworld
mo_gymnasium metaworld browsergym miniwob pettingzoo dm_control labmaze shimmy pybullet pybullet_envs nle minihack retro
stable_retro crafter vizdoom
"""
SIMULATORS = tuple(_NAMES.split())
"""Import names, or names of their files in a Python installation."""
