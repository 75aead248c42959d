BOOK = """
def story(a, b, hero):
    gold = 0.0
    for chapter in range(80):
        u = hero(a, b)
        b = b + 0.05 * (u - 0.3 * b)
        a = a + 0.05 * b
        gold += -a * a
        if a > 3.0:
            break
    return gold
"""
shelf = {}
exec(BOOK, shelf)


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        heroes = [(lambda a, b, k=k: -k * a) for k in (0.5, 1.0, 2.0)]
        best = max(heroes, key=lambda hero: shelf["story"](float(obs[0]), float(obs[1]), hero))
        return [best(float(obs[0]), float(obs[1]))]
