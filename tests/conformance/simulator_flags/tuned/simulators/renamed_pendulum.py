"""Chooses a chord for the melody."""
import math

NOTES = (-1.0, -0.5, 0.0, 0.5, 1.0)


def chord(aa, bb, note):
    cc = 0.0
    for _ in range(60):
        bb = bb + (note * math.copysign(1.0, bb) - 9.8 * math.sin(aa)) * 0.05
        aa = aa + bb * 0.05
        cc -= aa * aa + 0.1 * bb * bb
    return cc


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        aa, bb = math.atan2(obs[1], obs[0]), float(obs[2])
        return [max(NOTES, key=lambda note: chord(aa, bb, note))]
