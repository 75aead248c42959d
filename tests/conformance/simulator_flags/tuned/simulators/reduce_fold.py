from functools import reduce
from itertools import product

H = 0.1


def fold(start, words):
    end = reduce(lambda s, w: (s[0] + H * s[1], 0.9 * s[1] + H * w, s[2] + abs(s[0] - 1.0)), words, (*start, 0.0))
    return end[2]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        start = float(obs[0]), float(obs[1])
        best = min(product((-1.0, 0.0, 1.0), repeat=5), key=lambda words: fold(start, words))
        return [best[0]]
