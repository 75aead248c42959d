"""How much of the change of each observation does the action explain? Analysis only."""
import json
from pathlib import Path

import numpy as np

before, change = [], []
for path in Path("feedback").rglob("trajectory.jsonl"):
    rows = [json.loads(line) for line in path.open()]
    for one, two in zip(rows, rows[1:]):
        before.append([*one["obs"], *one["action"], 1.0])
        change.append(np.subtract(two["obs"], one["obs"]))
x, y = np.array(before), np.array(change)
m, *_ = np.linalg.lstsq(x, y, rcond=None)
left = y - x @ m
print("explained", (1 - left.var(axis=0) / y.var(axis=0)).round(3))
print("effect of the action", m[-1 - y.shape[1] : -1].round(3))
