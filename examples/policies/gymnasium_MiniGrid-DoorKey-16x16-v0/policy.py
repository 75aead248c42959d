"""Door and key: a memory of the map and a list of wishes, of which the first that can be fulfilled is
pursued.

Goal in reach: walk onto it. Key in hand and the door known: open it. Key known: fetch it. Otherwise look
where most is unseen. `gridmap.py` holds the map, the shortest routes over poses (cell and direction), and the
choice of where to look.
"""

from gridmap import DOOR, GOAL, KEY, LEFT, LOCKED, PICK_UP, GridMap


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
            self.route, self.finally_do = self.plan()
        return self.map.acted(self.map.follow(self.route) if self.route else self.finally_do)

    def plan(self):
        """Poses to pass, and what to do at the last of them."""
        world = self.map
        for goal in world.find(GOAL):
            route = world.route_onto(goal)
            if route:
                return route, LEFT
        if world.carried:
            for door in world.find(DOOR, state=LOCKED):
                route = world.route_onto(door)
                if route:
                    return route, LEFT
        else:
            for key in world.find(KEY):
                route = world.route_facing(key)
                if route is not None:
                    return route, PICK_UP
        return world.route_to_news() or [], LEFT
