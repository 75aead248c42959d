"""Trains a table on mazes of my own making."""
import random

AHEAD = ((1, 0), (0, 1), (-1, 0), (0, -1))


class Maze:
    def __init__(self, size):
        self.size = size

    def begin(self):
        self.walls = {(random.randrange(self.size), random.randrange(self.size)) for _ in range(self.size)}
        self.at, self.facing, self.moves = (0, 0), 0, 0
        return self.view()

    def view(self):
        dx, dy = AHEAD[self.facing]
        return self.facing, (self.at[0] + dx, self.at[1] + dy) in self.walls

    def go(self, act):
        self.moves += 1
        if act == 0:
            self.facing = (self.facing - 1) % 4
        elif act == 1:
            self.facing = (self.facing + 1) % 4
        else:
            dx, dy = AHEAD[self.facing]
            spot = (self.at[0] + dx, self.at[1] + dy)
            if spot not in self.walls and 0 <= spot[0] < self.size and 0 <= spot[1] < self.size:
                self.at = spot
        there = self.at == (self.size - 1, self.size - 1)
        prize = 1 - 0.9 * self.moves / (10 * self.size**2) if there else 0.0
        return self.view(), prize, there or self.moves >= 10 * self.size**2


table = {}
for _ in range(5000):
    maze = Maze(16)
    seen, over = maze.begin(), False
    while not over:
        act = random.randrange(3) if random.random() < 0.1 else max(range(3), key=lambda a: table.get((seen, a), 0))
        then, prize, over = maze.go(act)
        table[seen, act] = table.get((seen, act), 0) * 0.9 + 0.1 * (prize + 0.95 * max(table.get((then, a), 0) for a in range(3)))
        seen = then
