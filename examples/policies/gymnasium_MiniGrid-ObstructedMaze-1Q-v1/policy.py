"""Obstructed maze: a memory of the map and a list of wishes, of which the first that can be fulfilled is
pursued.

The blue ball in reach: empty the hands and take it. The right key in hand: open the upper door. The green
ball before that door: move it out of the way. The key known: fetch it. A box: open it, keys are hidden in
there. Otherwise look where most is unseen. `gridmap.py` holds the map, the shortest routes over poses (cell
and direction) and the choice of where to look; `errands.py` turns a wish into a route and an action.
"""

from errands import fetch, go_through, locked_doors, look_around, put_down
from gridmap import BALL, BOX, KEY, LEFT, PICK_UP, START, STEP, TOGGLE, UNSEEN, WALL, WIDTH, GridMap

BLUE = 2
BELOW = STEP[1]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.map = GridMap()
        self.route = []
        self.finally_do = LEFT
        # The way is to the right of the start: nothing on its left is worth a look.
        for cell in range(len(self.map.unseen)):
            if cell % WIDTH < START % WIDTH:
                self.map.ignore(cell)

    def act(self, obs):
        self.map.update(obs)
        if self.map.news or self.map.arrived(self.route):
            wishes = (
                self.blue_ball,
                self.open,
                self.unload,
                self.unblock,
                self.key,
                self.box,
                self.search,
                self.clear,
            )
            plans = (plan for wish in wishes if (plan := wish()))
            self.route, self.finally_do = next(plans, ([], LEFT))
        return self.map.acted(self.map.follow(self.route) if self.route else self.finally_do)

    def upper_door(self):
        """The locked door in the upper wall of the room with the boxes, if it is known: the room is below
        it.
        """
        for door in locked_doors(self.map):
            if self.map.kind[door + BELOW] not in (UNSEEN, WALL):
                return door
        return None

    def blue_ball(self):
        for ball in self.map.find(BALL, BLUE):
            if self.map.route_facing(ball) is not None:
                return put_down(self.map, then=ball) if self.map.carried else fetch(self.map, ball)
        return None

    def open(self):
        door = self.upper_door()
        if door and self.map.carried == (KEY, self.map.color[door]):
            return go_through(self.map, door)
        return None

    def unload(self):
        """Put down what is in hand, unless it is a key whose door may still turn up."""
        door = self.upper_door()
        if self.map.carried and (self.map.carried[0] != KEY or door):
            # Not between here and what has to be reached next.
            return (door and put_down(self.map, then=door + BELOW)) or put_down(self.map)
        return None

    def unblock(self):
        door = self.upper_door()
        if door and self.map.kind[door + BELOW] == BALL and not self.map.carried:
            return fetch(self.map, door + BELOW)
        return None

    def key(self):
        door = self.upper_door()
        if door and not self.map.carried:
            for key in self.map.find(KEY, self.map.color[door]):
                return fetch(self.map, key)
        return None

    def box(self):
        """Open the nearest box."""
        if self.map.carried:
            return None
        route = self.map.route(lambda cell, direction: self.map.kind[cell + STEP[direction]] == BOX)
        return None if route is None else (route, TOGGLE)

    def search(self):
        return look_around(self.map)

    def clear(self):
        """Nothing else is left to do, so something is in the way: take whatever can be taken."""
        if self.map.carried:
            return put_down(self.map)
        route = self.map.route(lambda cell, direction: self.map.kind[cell + STEP[direction]] in (KEY, BALL))
        return None if route is None else (route, PICK_UP)
