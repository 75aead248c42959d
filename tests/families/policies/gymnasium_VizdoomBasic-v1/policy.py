"""ViZDoom's basic scenario: the monster is blue and red before brown walls; stand opposite to it and shoot."""

import numpy as np

NOTHING, SHOOT, RIGHT, LEFT = range(4)
ROWS = slice(80, 160)
"""Of the screen in which the opposite wall is."""
MIDDLE = 160
CLOSE = 6
"""Columns that the monster may be from the middle when it is shot at."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self._waits = 0

    def act(self, obs):
        picture = obs["screen"][ROWS].astype(int)
        red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
        columns = np.nonzero((blue > red + 30) & (blue > green + 30))[1]
        if self._waits:
            self._waits -= 1
            return NOTHING
        if columns.size < 5:
            return NOTHING
        off = columns.mean() - MIDDLE
        if abs(off) > CLOSE:
            return RIGHT if off > 0 else LEFT
        # A shot takes a while, in which the next one would be wasted.
        self._waits = 12
        return SHOOT
