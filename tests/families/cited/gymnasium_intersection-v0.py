"""Waits before the crossing while another car is near it, and then crosses."""

SEEN = {"0, 2": "your car: y ÷ 100"} | {
    f"{row}, {column}": f"other car: {meaning}"
    for row in range(1, 15)
    for column, meaning in (
        (0, "1 where the row holds a car, else 0"),
        (1, "x ÷ 100"),
        (2, "y ÷ 100"),
        (3, "velocity along x ÷ 20"),
        (4, "velocity along y ÷ 20"),
    )
}
DONE = {
    "1": "keep lane and chosen speed",
    "0": "slower: choose the speed below the one nearest to the actual speed",
    "2": "faster: choose the speed above the one nearest to the actual speed",
}


def act(seen):
    y, *others = seen
    cars = [others[k : k + 5] for k in range(0, len(others), 5)]
    if 100 * y < 14:
        return 2
    for there, ox, oy, vx, vy in cars:
        # Where it is in the next seconds.
        for seconds in (0, 1, 2, 3):
            px, py = 100 * ox + 20 * vx * seconds, 100 * oy + 20 * vy * seconds
            if there and abs(px) < 14 and abs(py) < 14:
                return 0 if 100 * y < 34 else 1
    return 2
