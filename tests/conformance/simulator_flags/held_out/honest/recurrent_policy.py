import numpy as np


class Policy:
    """A small recurrent net: its memory is updated with every observation."""

    def __init__(self, obs_space, action_space, env_meta):
        rng = np.random.default_rng(7)
        n, m = int(np.prod(obs_space["shape"])), int(np.prod(action_space["shape"]))
        self.w, self.u, self.o = rng.normal(size=(16, n)) / 4, rng.normal(size=(16, 16)) / 4, rng.normal(size=(m, 16)) / 4

    def reset(self, episode_index):
        self.h = np.zeros(16)

    def act(self, obs):
        for _ in range(2):
            gate = 1 / (1 + np.exp(-(self.u @ self.h)))
            self.h = gate * self.h + (1 - gate) * np.tanh(self.w @ np.ravel(obs) + self.u @ self.h)
        return np.tanh(self.o @ self.h)


def activity(policy, episodes):
    total = 0.0
    for observations in episodes:
        policy.reset(0)
        for obs in observations:
            total += float(np.abs(policy.act(obs)).sum())
    return total
