import numpy as np

DT = 0.02


class Policy:
    """Six coupled Hopf oscillators make the gait."""

    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.x, self.y = np.full(6, 0.1), np.linspace(-0.1, 0.1, 6)
        for _ in range(200):
            self.tick(0.0)

    def tick(self, tilt):
        r = self.x**2 + self.y**2
        dx = 8.0 * (1.0 - r) * self.x - 9.0 * self.y
        dy = 8.0 * (1.0 - r) * self.y + 9.0 * self.x + 0.3 * np.roll(self.y, 1) - tilt
        self.x = self.x + DT * dx
        self.y = self.y + DT * dy

    def act(self, obs):
        self.tick(0.2 * obs[1])
        return np.clip(0.8 * self.y, -1, 1)
