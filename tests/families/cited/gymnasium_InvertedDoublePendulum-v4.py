"""Pushes the cart so that both poles come upright: the first pole must lean against the second."""

SEEN = {
    "0": "x of the cart",
    "1": "sine of the first pole's angle from upright",
    "2": "sine of the second pole's angle relative to the first",
    "5": "velocity of the cart",
    "6": "angular velocity of the first pole",
    "7": "angular velocity of the second pole",
}
DONE = {"0": "force on the cart; positive pushes it to positive x"}


def act(seen):
    x, first, second, speed, turning, bending = seen
    push = 0.15 * x + 1.27 * first + 4.59 * second + 0.23 * speed + 0.69 * turning + 0.69 * bending
    return [max(-1.0, min(1.0, -push))]
