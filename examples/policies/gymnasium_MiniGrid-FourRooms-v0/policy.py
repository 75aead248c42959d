"""Four rooms: remember every cell seen, look where most is unseen, walk straight to the goal once it shows.

`gridmap.py` holds the map, the shortest routes over poses (cell and direction, since turning costs a step
too), and the choice of where to look. What is special to this world: its walls are straight lines from end to
end, so two wall cells side by side give away the whole line, and nothing need be hoped for behind it but the
gaps.
"""

from gridmap import GOAL, LEFT, STEP, WALL, GridMap

REACH = 19
"""No line is longer than the world is wide."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.map = GridMap()
        self.route = []

    def reset(self, episode_index):
        self.map = GridMap()
        self.route = []

    def act(self, obs):
        self.map.update(obs)
        if self.map.news or self.map.arrived(self.route):
            self.expect_lines()
            self.route = self.plan() or []
        action = self.map.follow(self.route) if self.route else LEFT
        return self.map.acted(action)

    def plan(self):
        """Poses to pass: to the goal when it is known and can be reached, else to where most is to be
        seen.
        """
        goals = self.map.find(GOAL)
        return (goals and self.map.route_onto(goals[0])) or self.map.route_to_news()

    def expect_lines(self):
        """Prolong every piece of wall that is in view."""
        kind = self.map.kind
        for cell in self.map.in_view:
            for step in (STEP[0], STEP[1]):
                if kind[cell] == kind[cell + step] == WALL:
                    for away in range(-REACH, REACH + 1):
                        self.map.expect_wall(cell + away * step)
