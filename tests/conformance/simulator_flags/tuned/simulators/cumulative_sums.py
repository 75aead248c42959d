import numpy as np

DT = 0.05
PLANS = np.random.default_rng(3).uniform(-1, 1, size=(256, 20))


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        speeds = obs[1] + DT * np.cumsum(3.0 * PLANS, axis=1)
        places = obs[0] + DT * np.cumsum(speeds, axis=1)
        worth = -(np.abs(places - obs[2]) + 0.1 * PLANS**2).sum(axis=1)
        return [float(PLANS[np.argmax(worth), 0])]
