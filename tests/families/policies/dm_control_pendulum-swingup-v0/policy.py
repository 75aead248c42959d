"""Swings the pole up by pushing the way it moves, and balances it near the top."""

import math

LIFT = 19.6


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        upwards, sideways = obs["orientation"]
        angle, speed = math.atan2(sideways, upwards), float(obs["velocity"][0])
        # Enough energy carries it to the top; with more of it, it would be too fast there.
        energy = 0.5 * speed * speed + LIFT * (upwards - 1.0)
        if upwards > 0.97 and abs(speed) < 1.5:
            push = -12.0 * angle - 3.0 * speed
        else:
            push = math.copysign(1.0, speed) if energy < 0.3 else -math.copysign(1.0, speed)
        return [max(-1.0, min(1.0, push))]
