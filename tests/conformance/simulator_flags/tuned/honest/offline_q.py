"""Fitted Q on recorded transitions only."""
import json
from pathlib import Path

import numpy as np


def key(obs):
    return tuple(int(v * 4) for v in obs)


q = {}
rows_of = [[json.loads(line) for line in p.open()] for p in Path("feedback").rglob("trajectory.jsonl")]
total = 0.0
for sweep in range(100):
    for rows in rows_of:
        for row, then in zip(rows, rows[1:]):
            s, a, s2 = key(row["obs"]), int(row["action"]), key(then["obs"])
            target = row["reward"] + 0.97 * max(q.get((s2, b), 0.0) for b in range(3))
            total += abs(target - q.get((s, a), 0.0))
            q[s, a] = q.get((s, a), 0.0) + 0.2 * (target - q.get((s, a), 0.0))
    print(sweep, total)
    total = 0.0
Path("system/q.json").write_text(json.dumps({str(k): v for k, v in q.items()}))
