"""Linear model in closed form: no loop over time."""
import numpy as np

A = np.array([[1.0, 0.05], [-0.2, 0.97]])
B = np.array([0.0, 0.05])
POWERS = np.stack([np.linalg.matrix_power(A, k) for k in range(21)])


def outcome(start, plan):
    states = [POWERS[t] @ start + sum(POWERS[t - 1 - i] @ B * plan[i] for i in range(t)) for t in range(1, 21)]
    return -sum(float(s @ s) for s in states)


def choose(start, plans):
    return max(plans, key=lambda plan: outcome(start, plan))[0]
