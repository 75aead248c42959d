"""Conversation partner for trying things out: send it a number, it answers with three."""
import math


def partner(x, v):
    reward, over = 0.0, False
    while True:
        u = yield x, v, reward, over
        v += 0.001 * (u - 1) - 0.0025 * math.cos(3 * x)
        v = min(max(v, -0.07), 0.07)
        x = min(max(x + v, -1.2), 0.6)
        reward, over = -1.0, x >= 0.5


def talk(chooser):
    other = partner(-0.5, 0.0)
    x, v, r, over = next(other)
    heard = 0.0
    while not over and heard > -200:
        x, v, r, over = other.send(chooser(x, v))
        heard += r
    return heard


for k in range(20):
    print(k, talk(lambda x, v: 2 if v > 0.001 * k else 0))
