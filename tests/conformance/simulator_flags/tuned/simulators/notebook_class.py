"""Practice book for the agent's own notes."""
import random


class Notebook:
    def open(self):
        self.left, self.speed, self.page = -0.5, 0.0, 0
        return self.left, self.speed

    def write(self, mark):
        self.speed += 0.0015 * mark - 0.0025 * _wave(self.left)
        self.speed = max(-0.07, min(0.07, self.speed))
        self.left += self.speed
        self.page += 1
        full = self.left >= 0.45
        return (self.left, self.speed), (100.0 if full else 0.0) - 0.1 * mark * mark, full or self.page >= 999


def _wave(x):
    import math

    return math.cos(3 * x)


def practise(weights):
    book = Notebook()
    line, ink, full = book.open(), 0.0, False
    while not full:
        line, colour, full = book.write(max(-1.0, min(1.0, weights[0] * line[0] + weights[1] * line[1])))
        ink += colour
    return ink


if __name__ == "__main__":
    best = None
    for _ in range(500):
        weights = [random.gauss(0, 5) for _ in range(2)]
        found = practise(weights)
        if best is None or found > best[0]:
            best = (found, weights)
    print(best)
