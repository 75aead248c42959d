import numpy as np


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.stage, self.waited = "above", 0

    def act(self, obs):
        grip, block, goal = obs["observation"][:3], obs["observation"][3:6], obs["desired_goal"]
        targets = {"above": block + [0, 0, 0.08], "down": block, "close": block, "carry": goal}
        way = targets[self.stage] - grip
        if self.stage in ("above", "down") and np.linalg.norm(way) < 0.012:
            self.stage = {"above": "down", "down": "close"}[self.stage]
        elif self.stage == "close":
            self.waited += 1
            if self.waited > 3:
                self.stage = "carry"
        fingers = 1.0 if self.stage in ("above", "down") else -1.0
        return np.clip([*(8.0 * way), fingers], -1, 1)
