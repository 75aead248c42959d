import itertools
import math


def flow(drop, tilt):
    height, pace = drop
    pace = pace + 0.1 * (tilt - math.sin(height)) - 0.02 * pace
    return height + 0.1 * pace, pace


def puddle(drop, tilts):
    drops = itertools.accumulate(tilts, flow, initial=drop)
    return sum(-(h - 1.0) ** 2 for h, _ in drops)


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.sets = list(itertools.product((-1, 1), repeat=8))

    def reset(self, episode_index):
        pass

    def act(self, obs):
        drop = (float(obs[0]), float(obs[1]))
        return max(self.sets, key=lambda tilts: puddle(drop, tilts))[0]
