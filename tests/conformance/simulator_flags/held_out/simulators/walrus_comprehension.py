def ribbon(x, v, k):
    return sum(
        -abs(x - 2.0) - 0.05 * u * u
        for _ in range(50)
        if [u := k * (2.0 - x) - v, v := v + 0.05 * (u - 0.1 * v), x := x + 0.05 * v]
    )


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        x, v = float(obs[0]), float(obs[1])
        k = max((0.5, 1.0, 1.5, 2.0), key=lambda k: ribbon(x, v, k))
        return [k * (2.0 - x) - v]
