import math


class Policy:
    """A phase-locked loop follows the hip and times the knees."""

    def __init__(self, obs_space, action_space, env_meta):
        self.n = len(action_space["low"])

    def reset(self, episode_index):
        self.phase, self.rate, self.smooth = 0.0, 0.3, 0.0

    def act(self, obs):
        self.smooth = 0.9 * self.smooth + 0.1 * float(obs[4])
        error = self.smooth * math.cos(self.phase)
        self.rate = min(0.5, max(0.1, self.rate + 0.01 * error))
        self.phase = (self.phase + self.rate + 0.2 * error) % (2 * math.pi)
        return [0.7 * math.sin(self.phase + 2 * math.pi * k / self.n) for k in range(self.n)]
