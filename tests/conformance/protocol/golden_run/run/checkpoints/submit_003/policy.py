import json
import math
from pathlib import Path

from helpers.gain import gain


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.gain = gain(json.loads(Path("table.json").read_text()))

    def reset(self, episode_index):
        self.scale = math.copysign(1.0, 0.5 - episode_index % 2)

    def act(self, obs):
        return [self.gain * self.scale] if obs[0] > 0 or self.scale < 0 else [-0.25]
