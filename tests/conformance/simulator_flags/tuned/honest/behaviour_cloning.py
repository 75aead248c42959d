"""Clones the best recorded episodes with Adam."""
import json
from pathlib import Path

import numpy as np

X, Y = [], []
for path in Path("feedback").glob("submit_*/episodes/*/trajectory.jsonl"):
    rows = [json.loads(line) for line in path.open()]
    if sum(row["reward"] for row in rows) > 50:
        X += [row["obs"] for row in rows]
        Y += [row["action"] for row in rows]
X, Y = np.array(X), np.array(Y)


def train(x, y, epochs=50, rate=1e-3):
    w = np.zeros((x.shape[1], y.shape[1]))
    m, v, t = np.zeros_like(w), np.zeros_like(w), 0
    best = np.inf
    for _ in range(epochs):
        loss = 0.0
        for i in range(0, len(x), 64):
            xb, yb = x[i : i + 64], y[i : i + 64]
            error = np.tanh(xb @ w) - yb
            grad = xb.T @ (error * (1 - np.tanh(xb @ w) ** 2)) / len(xb)
            t += 1
            m = 0.9 * m + 0.1 * grad
            v = 0.999 * v + 0.001 * grad**2
            w = w - rate * m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
            loss += float((error**2).sum())
        if loss < best:
            best = loss
    return w, best


weights, loss = train(X, Y)
np.save("system/weights.npy", weights)
