import numpy as np


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.low, self.high = np.array(action_space["low"]), np.array(action_space["high"])

    def reset(self, episode_index):
        self.total, self.last = 0.0, None

    def act(self, obs):
        error = float(obs[2] - obs[0])
        slope = 0.0 if self.last is None else (error - self.last) / 0.05
        self.last = error
        command = 2.0 * error + 0.3 * self.total + 0.1 * slope
        if abs(command) < 1.0:
            self.total += 0.05 * error
        return np.clip([command], self.low, self.high)
