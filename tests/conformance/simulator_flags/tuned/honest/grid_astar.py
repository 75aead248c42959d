import heapq

MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))


def route(walls, start, goal):
    queue, seen = [(0, 0, start, ())], set()
    while queue:
        _, cost, (cell, facing), path = heapq.heappop(queue)
        if cell == goal:
            return path
        if (cell, facing) in seen:
            continue
        seen.add((cell, facing))
        for act, turn in ((0, -1), (1, 1)):
            heapq.heappush(queue, (cost + 1 + far(cell, goal), cost + 1, (cell, (facing + turn) % 4), (*path, act)))
        ahead = cell[0] + MOVES[facing][0], cell[1] + MOVES[facing][1]
        if ahead not in walls:
            heapq.heappush(queue, (cost + 1 + far(ahead, goal), cost + 1, (ahead, facing), (*path, 2)))
    return ()


def far(one, two):
    return abs(one[0] - two[0]) + abs(one[1] - two[1])


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.plan = []

    def act(self, obs):
        image = obs["image"]
        walls = {(i, j) for i in range(7) for j in range(7) if image[i][j][0] in (2, 4)}
        goals = [(i, j) for i in range(7) for j in range(7) if image[i][j][0] == 8]
        if goals:
            path = route(walls, ((3, 6), 3), goals[0])
            return path[0] if path else 2
        return 2 if (3, 5) not in walls else 1
