"""Key corridor: a memory of the map and a list of wishes, of which the first that can be fulfilled is
pursued.

The ball in reach: put the key down, pick up the ball. The key in hand: open the locked door. The key and the
door known: fetch the key. Otherwise look where most is unseen. `gridmap.py` holds the map, the shortest
routes over poses (cell and direction) and the choice of where to look; `errands.py` turns a wish into a route
and an action.
"""

from errands import fetch, go_through, locked_doors, look_around, put_down
from gridmap import BALL, KEY, LEFT, GridMap


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.map = GridMap()
        self.route = []
        self.finally_do = LEFT

    def act(self, obs):
        self.map.update(obs)
        if self.map.news or self.map.arrived(self.route):
            plans = (plan for wish in (self.ball, self.door, self.key, self.search) if (plan := wish()))
            self.route, self.finally_do = next(plans, ([], LEFT))
        return self.map.acted(self.map.follow(self.route) if self.route else self.finally_do)

    def ball(self):
        """There is only one ball; both hands are needed for it."""
        for ball in self.map.find(BALL):
            if self.map.route_facing(ball) is not None:
                return put_down(self.map, then=ball) if self.map.carried else fetch(self.map, ball)
        return None

    def door(self):
        for door in locked_doors(self.map):
            if self.map.carried == (KEY, self.map.color[door]):
                return go_through(self.map, door)
        return None

    def key(self):
        """There is only one key, and it opens the only locked door."""
        for key in self.map.find(KEY):
            if not self.map.carried:
                return fetch(self.map, key)
        return None

    def search(self):
        return look_around(self.map)
