import numpy as np


def gains(a, b, q, r, n=200):
    """LQR by iterating the Riccati equation to its fixed point."""
    p = q
    for _ in range(n):
        k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        new = q + a.T @ p @ (a - b @ k)
        if np.abs(new - p).max() < 1e-9:
            break
        p = new
    return k


K = gains(np.array([[1, 0.02], [0.3, 1]]), np.array([[0.0], [0.02]]), np.eye(2), np.array([[0.1]]))


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return np.clip(-K @ np.asarray(obs[:2]), -1, 1)
