"""Rig for gaits: springs, masses, a floor."""
import numpy as np

N = 5


def settle(amplitude, phase, seconds=4.0, dt=0.004):
    pos = np.stack([np.arange(N, dtype=float), np.ones(N)], axis=1)
    vel = np.zeros_like(pos)
    start = pos[:, 0].mean()
    for step in range(int(seconds / dt)):
        force = np.zeros_like(pos)
        force[:, 1] -= 9.81
        along = np.diff(pos, axis=0)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        rest = 1.0 + amplitude * np.sin(6.0 * step * dt + phase * np.arange(N - 1))[:, None]
        pull = 800.0 * (length - rest) * along / length
        force[:-1] += pull
        force[1:] -= pull
        force[pos[:, 1] < 0, 1] += 2000.0 * -pos[pos[:, 1] < 0, 1]
        vel = (vel + dt * force) * 0.999
        pos = pos + dt * vel
    return pos[:, 0].mean() - start


table = {(a, p): settle(a, p) for a in (0.1, 0.2, 0.3) for p in (0.0, 0.5, 1.0, 1.5)}
print(max(table, key=table.get))
