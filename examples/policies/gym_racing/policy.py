"""Car racing: trace the road's middle ahead of the car, steer for a point on it, slow down in time for bends.

Road is grey and grass green, so a pixel is road where green does not stand out. From the car on, the road is
scanned across, every few units of length; the middle found there says where the next scan is and how it is
turned, so the trace follows a bend even where the road comes back down the picture. Two numbers are taken
from the trace: the point to steer for (pure pursuit), and the highest speed from which the car can still
brake to what each bend ahead allows.
"""

import math

import numpy as np

CAR_ROW, CAR_COLUMN = 70.0, 47.5
PIXELS_X, PIXELS_Y = 1.56, 1.94
"""Pixels per unit of length, across and along, once the camera has zoomed in."""
ZOOM_STEPS = 40
"""While the camera zooms in, the trace is not trusted: straight on."""
STRIDE = 4.0
"""Units between scans."""
SCANS = 9
REACH = np.arange(-12, 13)
"""Units across at which a scan looks; the road is 13 wide."""
CENTRE = len(REACH) // 2
GREEN = 40
"""Where green exceeds red by more than this there is grass."""
STEER_FULL = 0.4
"""Angle of the front wheels (rad) at a steering of 1."""
WHEEL_BASE = 3.2
LOOK_AHEAD_S, LOOK_AHEAD_MIN = 0.22, 7.0
"""The point to steer for is as far as the car goes in this time, and no nearer than this (units)."""
STEER_GAIN = 1.6
GRIP = 150.0
"""Sideways acceleration that bends are taken with (units/s²)."""
BRAKING = 35.0
"""Deceleration that is counted on (units/s²)."""
TOP_SPEED = 62.0
GAS, BRAKE = 0.9, 0.5


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        self.t += 1
        speed = read_speed(obs)
        if self.t < ZOOM_STEPS:
            return np.array([0.0, GAS if speed < 20 else 0.0, 0.0])
        path = trace_road(obs)
        allowed = safe_speed(path)
        steering = steer(path, speed)
        gas = GAS * (1 - 0.5 * abs(steering)) if speed < allowed else 0.0
        brake = BRAKE * min(1.0, (speed - allowed) / 10) if speed > allowed + 1 else 0.0
        return np.array([steering, gas, brake])


def read_speed(obs):
    """Speed in units/s, from the length of the panel's white bar.

    Right beside the score text: Gymnasium before 1.4 writes that over the bar, and the speed is unreadable.
    """
    return max(0.0, obs[84:94, 12, :].min(axis=1).sum() / 253.0 * 20.0 - 3.0)


def trace_road(obs):
    """Points (x to the right, y ahead, in units from the car) on the road's middle, the car's place first."""
    road = obs[:84, :, 1] <= obs[:84, :, 0].astype(np.int16) + GREEN
    x, y, angle = 0.0, 0.0, 0.0
    points = [(x, y)]
    for _ in range(SCANS):
        x, y = x + STRIDE * math.sin(angle), y + STRIDE * math.cos(angle)
        rows = np.rint(CAR_ROW - PIXELS_Y * (y - REACH * math.sin(angle))).astype(int)
        columns = np.rint(CAR_COLUMN + PIXELS_X * (x + REACH * math.cos(angle))).astype(int)
        inside = (rows >= 0) & (rows < 84) & (columns >= 0) & (columns < 96)
        seen = inside & road[np.clip(rows, 0, 83), np.clip(columns, 0, 95)]
        middle = middle_of(seen.tolist())
        if middle is None or not inside[CENTRE]:
            break
        last_x, last_y = points[-1]
        x, y = x + middle * math.cos(angle), y - middle * math.sin(angle)
        points.append((x, y))
        if len(points) > 2:
            angle = math.atan2(x - last_x, y - last_y)
    return points


def middle_of(seen):
    """Middle of the stretch of road nearest to a scan's centre, in units from there; None without road."""
    here = min((i for i, road in enumerate(seen) if road), key=lambda i: abs(i - CENTRE), default=None)
    if here is None:
        return None
    left = right = here
    while left > 0 and seen[left - 1]:
        left -= 1
    while right < len(seen) - 1 and seen[right + 1]:
        right += 1
    return (left + right) / 2 - CENTRE


def steer(path, speed):
    """Steering, −1 to 1, on a circle through the point to steer for."""
    look_ahead = max(LOOK_AHEAD_MIN, LOOK_AHEAD_S * speed)
    x, y = next((point for point in path[1:] if math.hypot(*point) >= look_ahead), path[-1])
    curvature = 2 * x / max(x * x + y * y, 1.0)
    return max(-1.0, min(1.0, STEER_GAIN * math.atan(WHEEL_BASE * curvature) / STEER_FULL))


def safe_speed(path):
    """Highest speed now from which every bend of the path can be met at the speed that it allows."""
    allowed = TOP_SPEED
    for i in range(2, len(path) - 1):
        (x0, y0), (x1, y1), (x2, y2) = path[i - 2], path[i], path[min(i + 2, len(path) - 1)]
        turn = math.atan2(x2 - x1, y2 - y1) - math.atan2(x1 - x0, y1 - y0)
        turn = abs((turn + math.pi) % (2 * math.pi) - math.pi)
        curvature = turn / (0.5 * (math.hypot(x1 - x0, y1 - y0) + math.hypot(x2 - x1, y2 - y1)) + 1e-6)
        in_bend = math.sqrt(GRIP / max(curvature, 1e-3))
        allowed = min(allowed, math.sqrt(in_bend**2 + 2 * BRAKING * STRIDE * max(0, i - 2)))
    if len(path) < 4:
        allowed = min(allowed, 20.0)
    return allowed
