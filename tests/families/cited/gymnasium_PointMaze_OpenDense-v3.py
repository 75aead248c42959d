"""Pushes the ball to the goal and brakes it there."""

SEEN = {
    "desired_goal[0]": "x, y of the goal",
    "desired_goal[1]": "x, y of the goal",
    "observation[0]": "x, y of the ball",
    "observation[1]": "x, y of the ball",
    "observation[2]": "velocity along x",
    "observation[3]": "velocity along y",
}
DONE = {"0": "force along x", "1": "force along y"}


def act(seen):
    goal_x, goal_y, x, y, vx, vy = seen
    return [max(-1.0, min(1.0, 3 * (goal_x - x) - 2 * vx)), max(-1.0, min(1.0, 3 * (goal_y - y) - 2 * vy))]
