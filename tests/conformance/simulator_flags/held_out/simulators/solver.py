import numpy as np
from scipy.integrate import solve_ivp


def ballad(t, verse, tune):
    a, b, c, d = verse
    push = tune[0] * b + tune[1] * d
    return [c, d, -9.8 * np.sin(a) + push, 9.8 * np.sin(a - b) - push - 0.1 * d]


def sing(tune):
    heard = solve_ivp(ballad, (0.0, 10.0), [0.1, 0.0, 0.0, 0.0], args=(tune,), t_eval=np.linspace(0, 10, 50))
    return -np.abs(heard.y[0]).sum()


tunes = np.random.default_rng(1).normal(size=(300, 2))
print(max(tunes, key=sing))
