import numpy as np


def flood(road, start):
    stack, seen = [start], set()
    while stack:
        y, x = stack.pop()
        if (y, x) in seen or not (0 <= y < road.shape[0] and 0 <= x < road.shape[1]) or not road[y, x]:
            continue
        seen.add((y, x))
        stack += [(y + 1, x), (y - 1, x), (y, x + 1), (y, x - 1)]
    return seen


def cast(road, y, x, angle):
    length = 0.0
    while 0 <= int(y) < road.shape[0] and 0 <= int(x) < road.shape[1] and road[int(y), int(x)]:
        y -= np.cos(angle)
        x += np.sin(angle)
        length += 1.0
    return length


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.angles = np.linspace(-1.2, 1.2, 13)

    def reset(self, episode_index):
        pass

    def act(self, obs):
        road = obs[:84, :, 1] < 120
        rays = [cast(road, 70.0, 48.0, a) for a in self.angles]
        steer = float(self.angles[int(np.argmax(rays))])
        return [steer, 0.4 if max(rays) > 20 else 0.1, 0.0 if len(flood(road, (69, 48))) > 200 else 0.2]
