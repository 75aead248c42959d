"""Look around until the one object of the room is in view, go forward until it is beside, turn to it, and go up to
it."""

LEFT, RIGHT, FORWARD = 0, 1, 2
WALL, OBJECTS = 2, (5, 6, 7)
COLUMN, ROW = 3, 6
"""Where the agent stands in the picture, which it sees in the direction of falling rows."""
LOOKS = 4


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.looked = 0

    def reset(self, episode_index):
        self.looked = 0

    def act(self, obs):
        seen = obs["image"][:, :, 0]
        for column in range(7):
            for row in range(7):
                if seen[column, row] in OBJECTS:
                    if row < ROW:
                        return FORWARD
                    return LEFT if column < COLUMN else RIGHT
        self.looked += 1
        blocked = seen[COLUMN, ROW - 1] == WALL
        if self.looked % (LOOKS + 1) == 0 and not blocked:
            return FORWARD
        return RIGHT
