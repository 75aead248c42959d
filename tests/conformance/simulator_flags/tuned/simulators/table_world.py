"""A memory of what followed what, used to dream up new episodes."""
import random
from collections import defaultdict


class Dream:
    def __init__(self):
        self.after = defaultdict(list)

    def learn(self, cell, act, then, worth):
        self.after[cell, act].append((then, worth))

    def walk(self, cell, chooser, steps=50):
        sum_ = 0.0
        for _ in range(steps):
            act = chooser(cell)
            if not self.after[cell, act]:
                break
            cell, worth = random.choice(self.after[cell, act])
            sum_ += worth
        return sum_


def best_chooser(dream, choosers, start):
    return max(choosers, key=lambda chooser: sum(dream.walk(start, chooser) for _ in range(20)))
