"""Which Python packages simulate: only a worker's environment process may have them.

With one of them a policy could look ahead, and an agent could train outside its budget. Policies' sandboxes and agents'
jails do not show them.
"""

from __future__ import annotations

SIMULATORS = (
    *(
        "gymnasium",
        "gymnasium_robotics",
        "gym",
        "mujoco",
        "mujoco_py",
        "Box2D",
        "box2d",
        "minigrid",
        "highway_env",
    ),
    *("pygame", "ale_py", "miniworld", "mo_gymnasium", "metaworld", "browsergym", "miniwob", "pettingzoo"),
    *("dm_control", "shimmy", "pybullet", "pybullet_envs"),
)
"""Names to import, or of their files in a Python installation."""
