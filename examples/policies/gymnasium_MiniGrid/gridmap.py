"""A memory of a MiniGrid world, with routes through it and a sense of where to look next.

The agent sees a 7 x 7 window that turns with it and never its position, so the map counts positions from the
start: a `forward` has moved exactly when the cell ahead could be entered. Cells are numbered row by row in
one flat list; a pose is a (cell, direction).
"""

import heapq
from functools import cache

LEFT, RIGHT, FORWARD, PICK_UP, DROP, TOGGLE = range(6)
UNSEEN, EMPTY, WALL, FLOOR, DOOR, KEY, BALL, BOX, GOAL = range(9)
OPEN, CLOSED, LOCKED = range(3)

WIDTH = 96
"""Columns and rows of the map; the start is in its middle, and no world is wider than a quarter of it."""
START = (WIDTH // 2) * WIDTH + WIDTH // 2
STEP = (1, WIDTH, -1, -WIDTH)
"""What one step ahead adds to a cell's number, facing right, down, left, up."""
VIEW = 7
YES, NO = ord("1"), ord("0")


@cache
def spread(lit, clear):
    """How sight spreads along a row of the window, and from it to the next row ahead.

    `lit` and `clear` are rows of seven bits: where light enters, and which cells let it pass. Returns the
    row's visible cells and the cells of the next row that are lit. The rule is MiniGrid's own: first left to
    right, then back.
    """
    ahead = 0
    for order, step in ((range(VIEW - 1), 1), (range(VIEW - 1, 0, -1), -1)):
        for column in order:
            here, beside = 64 >> column, 64 >> (column + step)
            if lit & here and clear & here:
                lit |= beside
                ahead |= here | beside
    return lit, ahead


class GridMap:
    """What is known of the world. `update` first, with every observation; `acted` last, with every action."""

    def __init__(self):
        cells = WIDTH * WIDTH
        self.kind = [UNSEEN] * cells
        self.color = [0] * cells
        self.state = [0] * cells
        self.unseen = bytearray([YES]) * cells
        self.clear = bytearray([YES]) * cells
        """Cells that can be seen through, or are unseen; as digits, so that a slice reads as a binary number."""
        self.cell = START
        self.direction = 0
        self.carried = None
        """(kind, color) in hand, or None."""
        self.known = set()
        """Seen cells that are neither empty nor wall."""
        self.in_view = []
        """Cells that the last observation showed."""
        self.news = False
        """Whether the last observation showed anything that was not known."""
        self.last_action = None

    # -- remembering

    def update(self, obs):
        """Take in one observation."""
        image = obs["image"].tolist()
        self.direction = int(obs["direction"])
        if self.last_action == FORWARD and self.enterable(self.ahead()):
            self.cell += STEP[self.direction]
        hand = image[3][6]
        self.carried = (hand[0], hand[1]) if hand[0] in (KEY, BALL, BOX) else None
        self.news = self.kind[self.cell] == UNSEEN
        step, right = STEP[self.direction], STEP[(self.direction + 1) % 4]
        self.in_view = []
        for i, column in enumerate(image):
            for j, (kind, color, state) in enumerate(column):
                if kind != UNSEEN and (i, j) != (3, 6):
                    self._see(self.cell + (6 - j) * step + (i - 3) * right, kind, color, state)
        if self.kind[self.cell] == UNSEEN:
            self._see(self.cell, EMPTY, 0, 0)

    def _see(self, cell, kind, color, state):
        self.in_view.append(cell)
        if self.kind[cell] == kind and self.color[cell] == color and self.state[cell] == state:
            return
        self.news = True
        self.kind[cell], self.color[cell], self.state[cell] = kind, color, state
        self.unseen[cell] = NO
        self.clear[cell] = NO if kind == WALL or (kind == DOOR and state != OPEN) else YES
        if kind in (EMPTY, WALL):
            self.known.discard(cell)
        else:
            self.known.add(cell)

    def acted(self, action):
        """Remember what was done: the next `update` needs it. Returns the action."""
        self.last_action = action
        return action

    def ahead(self):
        return self.cell + STEP[self.direction]

    def enterable(self, cell):
        """Whether a step into this cell succeeds."""
        kind = self.kind[cell]
        return kind in (EMPTY, FLOOR, GOAL) or (kind == DOOR and self.state[cell] == OPEN)

    def find(self, kind, color=None, state=None):
        """Cells that are known to hold this, in a fixed order."""
        return sorted(
            cell
            for cell in self.known
            if self.kind[cell] == kind
            and (color is None or self.color[cell] == color)
            and (state is None or self.state[cell] == state)
        )

    # -- walking

    def entry_cost(self, cell):
        """Steps it takes to enter the cell ahead, None when it can't be done with what is in hand."""
        if self.enterable(cell):
            return 1
        if self.kind[cell] == DOOR:
            opens = self.state[cell] == CLOSED or self.carried == (KEY, self.color[cell])
            return 2 if opens else None
        return None

    def poses(self, blocked=(), start=None):
        """Every pose that can be reached, nearest first: (cost, cell, direction, the pose before)."""
        queue, done = [(0, *(start or (self.cell, self.direction)), None)], set()
        while queue:
            cost, cell, direction, before = heapq.heappop(queue)
            if (cell, direction) in done:
                continue
            done.add((cell, direction))
            yield cost, cell, direction, before
            here = (cell, direction)
            for turned in ((direction - 1) % 4, (direction + 1) % 4):
                if (cell, turned) not in done:
                    heapq.heappush(queue, (cost + 1, cell, turned, here))
            target = cell + STEP[direction]
            if (target, direction) not in done and target not in blocked:
                entry = self.entry_cost(target)
                if entry is not None:
                    heapq.heappush(queue, (cost + entry, target, direction, here))

    def route(self, arrived, blocked=()):
        """Poses on the quickest way to the first one for which `arrived(cell, direction)`; None without one."""
        before = {}
        for _, cell, direction, previous in self.poses(blocked):
            before[cell, direction] = previous
            if arrived(cell, direction):
                return trace(before, (cell, direction))
        return None

    def route_onto(self, goal, blocked=()):
        """The way to stand on a cell."""
        return self.route(lambda cell, direction: cell == goal, blocked)

    def route_facing(self, goal, blocked=()):
        """The way to stand before a cell, looking at it."""
        return self.route(lambda cell, direction: cell + STEP[direction] == goal, blocked)

    def arrived(self, route):
        """Whether nothing of a route is left to go; poses that were reached are taken off its front."""
        while route and route[0] == (self.cell, self.direction):
            route.pop(0)
        return not route

    def follow(self, route):
        """The action that leads towards the next pose of a route. The route must not be empty."""
        cell, direction = route[0]
        if cell != self.cell:
            return FORWARD if self.enterable(cell) else TOGGLE
        return RIGHT if direction == (self.direction + 1) % 4 else LEFT

    # -- looking

    def expect_wall(self, cell):
        """Take an unseen cell for a wall that hides the cells behind it, until it is seen."""
        if self.kind[cell] == UNSEEN:
            self.clear[cell] = NO

    def ignore(self, cell):
        """Take a cell for one not worth a look."""
        self.unseen[cell] = NO

    def novelty(self, cell, direction):
        """How many unseen cells could come into view at this pose, if what is unseen hides nothing."""
        step, right = STEP[direction], STEP[(direction + 1) % 4]
        start, lit, total = cell - 3 * right, 8, 0
        for _ in range(VIEW):
            row = slice(start, start + VIEW * right, right)
            lit, ahead = spread(lit, int(self.clear[row], 2) | (8 if start == cell - 3 * right else 0))
            total += (int(self.unseen[row], 2) & lit).bit_count()
            if not ahead:
                break
            start, lit = start + step, ahead
        return total

    def route_to_news(self, patience=3):
        """The way to the pose with the most novelty / (cost + patience); None when all is seen."""
        before, best, goal = {}, 0.0, None
        for cost, cell, direction, previous in self.poses():
            before[cell, direction] = previous
            if VIEW * VIEW / (cost + patience) <= best:
                break
            worth = self.novelty(cell, direction) / (cost + patience)
            if worth > best:
                best, goal = worth, (cell, direction)
        return trace(before, goal) if goal else None


def trace(before, pose):
    """The poses from the start, which has none before it, to this one; the start itself left out."""
    route = []
    while before[pose] is not None:
        route.append(pose)
        pose = before[pose]
    return route[::-1]
