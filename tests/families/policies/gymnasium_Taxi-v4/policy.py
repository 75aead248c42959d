"""Drive the shortest way to the passenger, then to the destination; the way is found by a breadth-first search on the
map."""

PLACES = ((0, 0), (0, 4), (4, 0), (4, 3))
IN_TAXI = 4
WALLS = {(0, 1), (1, 1), (3, 0), (3, 2), (4, 0), (4, 2)}
"""Row and column of the cells with a wall on their right."""
SOUTH, NORTH, EAST, WEST, PICK_UP, DROP_OFF = range(6)


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        rest, destination = divmod(int(obs), 4)
        rest, passenger = divmod(rest, 5)
        here = divmod(rest, 5)
        goal = PLACES[destination if passenger == IN_TAXI else passenger]
        if here == goal:
            return DROP_OFF if passenger == IN_TAXI else PICK_UP
        return first_move(here, goal)


def first_move(here, goal):
    """The first move of a shortest way; the search begins at the goal and ends at the taxi."""
    reached, front = {goal}, [goal]
    while front:
        following = []
        for cell in front:
            for move, neighbour in moves(cell):
                if neighbour == here:
                    return BACK[move]
                if neighbour not in reached:
                    reached.add(neighbour)
                    following.append(neighbour)
        front = following
    return SOUTH


BACK = {SOUTH: NORTH, NORTH: SOUTH, EAST: WEST, WEST: EAST}


def moves(cell):
    row, column = cell
    if row < 4:
        yield SOUTH, (row + 1, column)
    if row > 0:
        yield NORTH, (row - 1, column)
    if column < 4 and cell not in WALLS:
        yield EAST, (row, column + 1)
    if column > 0 and (row, column - 1) not in WALLS:
        yield WEST, (row, column - 1)
