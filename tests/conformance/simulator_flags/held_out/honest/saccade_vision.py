import numpy as np


def hash_of(image):
    value = 5381
    for byte in image.tobytes():
        value = (value * 33 + byte) & 0xFFFFFFFF
    return value


def power_direction(points, n=30):
    centred = points - points.mean(axis=0)
    cov = centred.T @ centred
    d = np.array([1.0, 0.3])
    for _ in range(n):
        d = cov @ d
        d = d / np.linalg.norm(d)
    return d


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.seen = {}

    def reset(self, episode_index):
        self.x, self.y, self.kept = 48.0, 60.0, 0.0

    def act(self, obs):
        dark = np.argwhere(obs[:84, :, 1] < 110)
        if len(dark) < 10:
            return [0.0, 0.1, 0.0]
        d = power_direction(dark.astype(float))
        self.x += 0.3 * (float(dark[:, 1].mean()) - self.x)
        self.kept = 0.5 * self.kept + 0.5 * float(np.arctan2(d[1], -d[0]))
        self.seen[hash_of(obs[::8, ::8])] = self.kept
        return [float(np.clip((self.x - 48) / 30 + self.kept, -1, 1)), 0.3, 0.0]
