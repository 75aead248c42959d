"""Shadow play: where the hand's shadow falls."""

LIGHTS = [-2.0, -1.0, 0.0, 1.0, 2.0]


def shadow(now, before, light):
    brightness = 0.0
    for _ in range(30):
        now, before = 2 * now - before + 0.0004 * (light - 3.0 * now), now
        brightness -= (now - 0.5) ** 2
    return brightness


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.before = None

    def reset(self, episode_index):
        self.before = None

    def act(self, obs):
        now = float(obs[0])
        before, self.before = (now if self.before is None else self.before), now
        best, chosen = None, 0.0
        for light in LIGHTS:
            value = shadow(now, before, light)
            if best is None or value > best:
                best, chosen = value, light
        return [chosen]
