"""Turns both joints so that the fingertip goes the way to the target, gently: torque is dear."""

SEEN = {
    "0": "cosine of the first joint's angle",
    "1": "cosine of the second joint's angle",
    "2": "sine of the first joint's angle",
    "3": "sine of the second joint's angle",
    "6": "angular velocity of the first joint",
    "7": "angular velocity of the second joint",
    "8": "x of fingertip minus x of target",
    "9": "y of fingertip minus y of target",
}
DONE = {"0": "torque on the first joint", "1": "torque on the second joint"}


def act(seen):
    c1, c2, s1, s2, turning, bending, dx, dy = seen
    # Where the fingertip goes when a joint turns: across the link's direction.
    c12, s12 = c1 * c2 - s1 * s2, s1 * c2 + c1 * s2
    second = dx * s12 - dy * c12
    first = dx * s1 - dy * c1 + second
    return [
        max(-1.0, min(1.0, 0.3 * first - 0.015 * turning)),
        max(-1.0, min(1.0, 0.3 * second - 0.015 * bending)),
    ]
