import numpy as np


class Policy:
    """Merges when every car's time to the crossing differs enough from ours."""

    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.wait = 0

    def act(self, obs):
        cars = [row for row in obs[1:] if row[0] > 0]
        speed = max(0.1, float(np.hypot(obs[0][3], obs[0][4])))
        ours = float(np.hypot(obs[0][1], obs[0][2])) / speed
        worst = 9.0
        for _, x, y, vx, vy in cars:
            theirs = np.hypot(x, y) / max(0.1, np.hypot(vx, vy))
            closing = -(x * vx + y * vy)
            if closing > 0:
                worst = min(worst, abs(theirs - ours))
        self.wait = 0 if worst > 0.6 else self.wait + 1
        return 3 if worst > 1.2 else (1 if worst > 0.6 or self.wait > 4 else 4)
