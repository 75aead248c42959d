"""Walk to the stairs when they are seen, otherwise to the nearest cell beside unknown ones; kick locked doors, and
search where nothing is left."""

from collections import deque

MOVES = [(-1, 0), (0, 1), (1, 0), (0, -1), (-1, 1), (1, 1), (1, -1), (-1, -1)]
"""Directions in the order of the choices from 1 on."""
KICK, SEARCH = 20, 22
ROWS, COLUMNS = 21, 79
BROWN, STAIRS, CORRIDOR, UNKNOWN = 3, 62, 35, 32
WALLS = {ord(c) for c in " |-}0`"}
DOORS = {ord(c) for c in "+-|"}
SEARCHES = 12


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.stairs = None
        self.visited = set()
        self.blocked = {}
        self.searched = {}
        self.going = None  # the cell where a move began, the move, and the cell where it leads
        self.path = []
        self.answer = None
        self.searching = 0

    def act(self, obs):
        message = bytes(obs["message"]).rstrip(b"\0")
        if self.answer is not None:
            answer, self.answer = self.answer, None
            if b"direction" in message:
                return answer
        here = (int(obs["blstats"][1]), int(obs["blstats"][0]))
        self.visited.add(here)
        if self.stairs is None and STAIRS in obs["chars"]:
            rows, columns = (obs["chars"] == STAIRS).nonzero()
            self.stairs = (int(rows[0]), int(columns[0]))
            self.path = []
            self.searching = 0
        if self.going is not None and self.going[2] != here:
            start, move, _ = self.going
            self.path = []
            if start == here:
                if b"locked" in message:
                    self.answer = 1 + move
                    return KICK
                self.blocked[start, move] = self.blocked.get((start, move), 0) + 1
        self.going = None
        if self.searching:
            self.searching -= 1
            return SEARCH
        if not self.path:
            self.path = self.way(here, obs["chars"].tolist(), obs["colors"].tolist())
        if not self.path:
            self.searched[here] = self.searched.get(here, 0) + 1
            if self.searched[here] > 3:
                self.blocked, self.searched = {}, {}
            self.searching = SEARCHES
            return SEARCH
        move = self.path.pop(0)
        self.going = (here, move, (here[0] + MOVES[move][0], here[1] + MOVES[move][1]))
        return 1 + move

    def way(self, here, chars, colours):
        """A shortest way: to the stairs, else to what is unknown, else to where a hidden door may be. Empty: stay."""

        def door(cell):
            return chars[cell[0]][cell[1]] in DOORS and colours[cell[0]][cell[1]] == BROWN

        def around(cell, found):
            return sum(
                not (0 <= cell[0] + down < ROWS and 0 <= cell[1] + right < COLUMNS)
                or chars[cell[0] + down][cell[1] + right] in found
                for down, right in MOVES
            )

        before = {here: None}
        queue, found = deque([here]), None
        while queue:
            cell = queue.popleft()
            if cell == self.stairs:
                found = cell
                break
            if found is None and cell not in self.visited:
                char = chars[cell[0]][cell[1]]
                if char == CORRIDOR or door(cell) or around(cell, {UNKNOWN}):
                    found = cell
                    if self.stairs is None:
                        break
            for move, (down, right) in enumerate(MOVES):
                other = (cell[0] + down, cell[1] + right)
                if other in before or not (0 <= other[0] < ROWS and 0 <= other[1] < COLUMNS):
                    continue
                if chars[other[0]][other[1]] in WALLS and not door(other):
                    continue
                if self.blocked.get((cell, move), 0) > 2 or (down and right and (door(other) or door(cell))):
                    continue
                before[other] = (cell, move)
                queue.append(other)
        if found is None:
            quiet = (each for each in before if around(each, WALLS) >= 5)
            found = min(quiet, key=lambda each: self.searched.get(each, 0), default=here)
        path = []
        while before[found] is not None:
            found, move = before[found]
            path.append(move)
        return path[::-1]
