"""Finds thresholds that separate good from bad recorded episodes, by annealing over the records."""
import json
import math
import random
from pathlib import Path

records = [json.loads(p.read_text()) for p in Path("feedback").glob("submit_*/summary.json")]
rows = [(r["mean_episode_length"], r["std_return"], r["mean_return"]) for r in records if r["returns"]]


def separation(cut):
    good = [r for r in rows if r[0] > cut[0] and r[1] < cut[1]]
    bad = [r for r in rows if r not in good]
    if not good or not bad:
        return -1e9
    return sum(r[2] for r in good) / len(good) - sum(r[2] for r in bad) / len(bad)


cut, heat, score, moves = (100.0, 10.0), 1.0, -1e9, 0
while heat > 0.01:
    other = (cut[0] + heat * random.gauss(0, 50), cut[1] + heat * random.gauss(0, 5))
    value = separation(other)
    if value > score or random.random() < math.exp(min(0.0, (value - score) / heat)):
        cut, score = other, value
    heat *= 0.99
    moves += 1
print(cut, score, moves)
