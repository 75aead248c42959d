"""Pushes the cart under the leaning pole, and back to the middle."""

SEEN = {
    "0": "x of the cart",
    "1": "angle of the pole from upright; positive leans to positive x",
    "2": "velocity of the cart",
    "3": "angular velocity of the pole",
}
DONE = {"0": "force on the cart; positive pushes it to positive x"}


def act(seen):
    x, lean, speed, turning = seen
    return [max(-3.0, min(3.0, 0.3 * x + 12 * lean + 0.6 * speed + 2 * turning))]
