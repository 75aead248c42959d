"""Discounted returns, lengths and correlations of all submits."""
import json
from pathlib import Path

import numpy as np


def discounted(rewards, gamma=0.99):
    out, value = [], 0.0
    for reward in reversed(rewards):
        value = reward + gamma * value
        out.append(value)
    return out[::-1]


table = []
for path in sorted(Path("feedback").glob("submit_*/episodes/*/trajectory.jsonl")):
    rows = [json.loads(line) for line in path.open()]
    rewards = [row["reward"] for row in rows]
    running = np.cumsum(rewards)
    table.append((path.parts[1], sum(rewards), len(rows), discounted(rewards)[0], int(np.argmax(running))))
best = max(table, key=lambda row: row[1])
print(best)
for submit in sorted({row[0] for row in table}):
    mine = np.array([row[1:] for row in table if row[0] == submit])
    print(submit, mine.mean(axis=0).round(2), np.corrcoef(mine.T)[0].round(2))
