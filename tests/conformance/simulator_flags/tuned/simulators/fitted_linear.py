"""Fits a linear model to the feedback and plans with random shooting in it."""
import glob
import json

import numpy as np


def load():
    before, after = [], []
    for path in glob.glob("feedback/submit_*/episodes/*/trajectory.jsonl"):
        rows = [json.loads(line) for line in open(path)]
        for one, two in zip(rows, rows[1:]):
            before.append([*one["obs"], *one["action"]])
            after.append(two["obs"])
    return np.array(before), np.array(after)


X, Y = load()
M, *_ = np.linalg.lstsq(X, Y, rcond=None)


def imagine(obs, gains):
    total = 0.0
    for _ in range(100):
        action = np.clip(gains @ obs, -1, 1)
        obs = np.concatenate([obs, action]) @ M
        total += float(obs[0] - 0.1 * action @ action)
    return total


rng = np.random.default_rng(0)
candidates = [rng.normal(size=(2, Y.shape[1])) for _ in range(2000)]
scores = [imagine(Y[0], gains) for gains in candidates]
np.save("system/gains.npy", candidates[int(np.argmax(scores))])
