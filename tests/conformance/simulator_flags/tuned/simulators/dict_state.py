import copy
import math
import random


def forward(world, gas, wheel):
    world["x"] += world["s"] * math.cos(world["h"]) * 0.2
    world["y"] += world["s"] * math.sin(world["h"]) * 0.2
    world["h"] += world["s"] * math.tan(wheel) / 5.0 * 0.2
    world["s"] += gas * 0.2
    return world


def try_out(world, plan):
    world = copy.deepcopy(world)
    got = 0.0
    for gas, wheel in plan:
        forward(world, gas, wheel)
        got -= math.hypot(world["x"] - world["gx"], world["y"] - world["gy"])
        if abs(world["x"]) > 30:
            got -= 5
            break
    return got


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.random = random.Random(episode_index)

    def act(self, obs):
        o, g = obs["observation"], obs["desired_goal"]
        world = {"x": o[0], "y": o[1], "s": math.hypot(o[2], o[3]), "h": math.atan2(o[5], o[4]), "gx": g[0], "gy": g[1]}
        plans = [[(self.random.uniform(-1, 1), self.random.uniform(-1, 1))] * 10 for _ in range(100)]
        return list(max(plans, key=lambda plan: try_out(world, plan))[0])
