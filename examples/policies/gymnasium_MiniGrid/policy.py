"""Four MiniGrid worlds: a memory of the map and a list of wishes, of which the first that can be fulfilled is
pursued.

A wish is a function of the map. It returns a plan, (poses to pass, what to do at the last of them), or None.
`gridmap.py` holds the map, the shortest routes over poses (cell and direction, since turning costs a step too), and
the choice of where to look; `errands.py` turns a wish into a route and an action.
"""

from errands import fetch, go_through, locked_doors, look_around, put_down
from gridmap import BALL, BOX, GOAL, KEY, LEFT, PICK_UP, START, STEP, TOGGLE, UNSEEN, WALL, WIDTH, GridMap

BLUE = 2
BELOW = STEP[1]
REACH = 19
"""No wall of the four rooms is longer than their world is wide."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.world = next(name for name in WISHES if name in env_meta["env"])
        self.reset(0)

    def reset(self, episode_index):
        self.map = GridMap()
        self.route = []
        self.finally_do = LEFT
        if self.world == "ObstructedMaze":
            # The way is to the right of the start: nothing on its left is worth a look.
            for cell in range(len(self.map.unseen)):
                if cell % WIDTH < START % WIDTH:
                    self.map.ignore(cell)

    def act(self, obs):
        self.map.update(obs)
        if self.map.news or self.map.arrived(self.route):
            if self.world == "FourRooms":
                expect_lines(self.map)
            plans = (plan for wish in WISHES[self.world] if (plan := wish(self.map)))
            self.route, self.finally_do = next(plans, ([], LEFT))
        return self.map.acted(self.map.follow(self.route) if self.route else self.finally_do)


def expect_lines(world):
    """Prolong every piece of wall that is in view: walls are straight lines from end to end, so two wall cells side
    by side give away the whole line, and nothing need be hoped for behind it but the gaps.
    """
    for cell in world.in_view:
        for step in STEP[:2]:
            if world.kind[cell] == world.kind[cell + step] == WALL:
                for away in range(-REACH, REACH + 1):
                    world.expect_wall(cell + away * step)


def goal(world):
    plans = (go_through(world, cell) for cell in world.find(GOAL))
    return next(filter(None, plans), None)


def ball(world, color=None):
    """Both hands are needed for it."""
    for thing in world.find(BALL, color):
        if world.route_facing(thing) is not None:
            return put_down(world, then=thing) if world.carried else fetch(world, thing)
    return None


def blue_ball(world):
    return ball(world, BLUE)


def door(world):
    for locked in locked_doors(world):
        if world.carried == (KEY, world.color[locked]):
            return go_through(world, locked)
    return None


def key(world):
    """There is only one key, and it opens the only locked door."""
    for thing in world.find(KEY):
        if not world.carried:
            return fetch(world, thing)
    return None


def upper_door(world):
    """The locked door in the upper wall of the room with the boxes, if it is known: the room is below it."""
    for locked in locked_doors(world):
        if world.kind[locked + BELOW] not in (UNSEEN, WALL):
            return locked
    return None


def open_upper_door(world):
    upper = upper_door(world)
    if upper and world.carried == (KEY, world.color[upper]):
        return go_through(world, upper)
    return None


def unload(world):
    """Put down what is in hand, unless it is a key whose door may still turn up."""
    upper = upper_door(world)
    if world.carried and (world.carried[0] != KEY or upper):
        # Not between here and what has to be reached next.
        return (upper and put_down(world, then=upper + BELOW)) or put_down(world)
    return None


def unblock(world):
    """Move the ball before the upper door out of the way."""
    upper = upper_door(world)
    if upper and world.kind[upper + BELOW] == BALL and not world.carried:
        return fetch(world, upper + BELOW)
    return None


def upper_key(world):
    upper = upper_door(world)
    if upper and not world.carried:
        for thing in world.find(KEY, world.color[upper]):
            return fetch(world, thing)
    return None


def box(world):
    """Open the nearest box: keys are hidden in there."""
    return None if world.carried else nearest(world, (BOX,), TOGGLE)


def clear(world):
    """Nothing else is left to do, so something is in the way: take whatever can be taken."""
    return put_down(world) if world.carried else nearest(world, (KEY, BALL), PICK_UP)


def nearest(world, kinds, action):
    """Go to the nearest thing of these kinds, and do this there."""
    route = world.route(lambda cell, direction: world.kind[cell + STEP[direction]] in kinds)
    return None if route is None else (route, action)


WISHES = {
    "DoorKey": (goal, door, key, look_around),
    "FourRooms": (goal, look_around),
    "KeyCorridor": (ball, door, key, look_around),
    "ObstructedMaze": (
        *(blue_ball, open_upper_door, unload, unblock, upper_key),
        *(box, look_around, clear),
    ),
}
"""By a part of the environment's id, first wish first."""
