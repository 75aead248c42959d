import math


def bisect(f, low, high):
    for _ in range(60):
        middle = 0.5 * (low + high)
        if f(middle) > 0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


def secant(f, a, b):
    steps = 0
    while abs(b - a) > 1e-9 and steps < 50:
        a, b = b, b - f(b) * (b - a) / (f(b) - f(a) + 1e-12)
        steps += 1
    return b


class Policy:
    """The release angle that the ball needs, from the flight's closed form."""

    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.angle = None

    def act(self, obs):
        speed, gap = float(obs[3]) + 1e-6, float(obs[0])
        f = lambda a: speed**2 * math.sin(2 * a) / 9.81 - gap
        self.angle = bisect(f, 0.0, math.pi / 4)
        return [secant(f, self.angle, self.angle + 0.01)]
