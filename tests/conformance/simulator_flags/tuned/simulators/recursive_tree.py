import math

CHOICES = (-1, 0, 1)


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.depth = 6

    def reset(self, episode_index):
        pass

    def act(self, obs):
        a, b, c, d = (float(v) for v in obs)
        return max(CHOICES, key=lambda u: self.value(*self.moved(a, b, c, d, u), self.depth)) + 1

    def moved(self, a, b, c, d, u):
        temp = (10 * u + 0.05 * d * d * math.sin(c)) / 1.1
        acc = (9.8 * math.sin(c) - math.cos(c) * temp) / (0.5 * (4 / 3 - 0.1 * math.cos(c) ** 2 / 1.1))
        return a + 0.02 * b, b + 0.02 * (temp - 0.05 * acc * math.cos(c) / 1.1), c + 0.02 * d, d + 0.02 * acc

    def value(self, a, b, c, d, depth):
        if abs(a) > 2.4 or abs(c) > 0.2:
            return -10.0
        if depth == 0:
            return 1.0 - abs(c)
        return 1.0 + max(self.value(*self.moved(a, b, c, d, u), depth - 1) for u in CHOICES)
