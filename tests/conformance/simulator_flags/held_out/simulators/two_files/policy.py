from calendar_tools import days

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.weeks = ((0, 0), (0, 1), (1, 0), (1, 1))

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        ranked = sorted(self.weeks, key=lambda week: self.harvest(obs, week))
        return ranked[-1][0]

    def harvest(self, obs, week):
        field = list(obs)
        grain = 0.0
        for day in range(14):
            field = days(field, week[day % 2])
            grain += field[0] - 0.01 * field[1] ** 2
        return grain
