"""Distances over the cells seen so far by sweeping, then downhill."""
import numpy as np


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.shape = (32, 32)

    def reset(self, episode_index):
        self.free = np.zeros(self.shape, dtype=bool)

    def act(self, obs):
        image = np.asarray(obs["image"])
        self.free[12:19, 12:19] |= image[:, :, 0] == 1
        goal = np.argwhere(image[:, :, 0] == 8)
        field = np.full(self.shape, 1e3)
        if len(goal):
            field[12 + goal[0][0], 12 + goal[0][1]] = 0.0
        for _ in range(60):
            padded = np.pad(field, 1, constant_values=1e3)
            near = np.minimum.reduce([padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]])
            new = np.where(self.free, np.minimum(field, near + 1.0), field)
            if np.allclose(new, field):
                break
            field = new
        here = field[15, 18]
        return 2 if field[15, 17] < here else 1
