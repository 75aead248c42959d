"""Unit tests of my controller on made-up inputs."""
import math

from policy import Policy

SPACE = {"type": "Box", "shape": [1], "low": [-1.0], "high": [1.0], "dtype": "float32"}


def make():
    policy = Policy(None, SPACE, {"max_episode_steps": 999})
    policy.reset(0)
    return policy


def test_action_is_in_bounds():
    policy = make()
    for k in range(500):
        action = policy.act([math.sin(0.1 * k), math.cos(0.1 * k)])
        assert -1.0 <= action[0] <= 1.0


def test_filter_settles():
    policy = make()
    for _ in range(200):
        last = policy.act([0.3, 0.0])
    assert abs(last[0] - policy.act([0.3, 0.0])[0]) < 1e-6


def test_integral_is_bounded():
    policy = make()
    worst = 0.0
    for _ in range(2000):
        worst = max(worst, abs(policy.act([1.0, 0.0])[0]))
    assert worst <= 1.0
