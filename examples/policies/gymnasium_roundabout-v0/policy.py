"""Roundabout: try out speed plans against a forecast of the traffic, every second, and take the first step of
the best.

The built-in driver steers, so the way is known beforehand and only the speed along it is to be chosen. Each
plan is a sequence of choices for the next seconds; the forecast lets the other cars go round at their present
speed. A plan earns what the environment pays for speed and loses for every moment too near to another car.
Lanes are never changed.
"""

import itertools

import numpy as np

KEEP, FASTER, SLOWER = 1, 3, 4
SPEEDS = np.array([0.0, 8.0, 16.0])
"""What can be chosen, in m/s."""
RESPONSE_S = 0.6
"""The car closes in on the chosen speed with this time constant."""
PLANNED = 3
"""Seconds with a choice of their own; from then on the plan goes as fast as it can."""
HORIZON_S = 6
SLICES = 5
"""Moments a second at which distances are looked at."""
SPEED_REWARD = 0.2 / 2 / 1.2
"""Reward for each notch of speed and second."""
DANGER, DANGER_M = 4.0, 6.5
"""Loss per second at zero distance from another car, and the distance at which it begins."""
CAUTION, CAUTION_M = 0.15, 10.0
"""The same for being merely close."""
FORGET_S = 3
"""A car that is no longer shown is still expected where it would be, for this long."""
WAY = np.array(
    [
        (2.0, 60.0), (2.0, 44.5), (2.1, 41.0), (2.5, 36.8), (3.5, 32.1), (4.9, 27.3),
        (8.9, 24.1), (13.1, 21.0), (17.0, 17.4), (20.2, 13.2), (22.5, 8.4), (23.7, 3.2),
        (23.8, -2.1), (22.7, -7.3), (20.5, -12.2), (17.3, -16.4), (13.2, -19.8), (9.1, -23.2),
        (6.2, -27.6), (4.1, -32.5), (2.7, -37.7), (2.2, -43.0), (2.0, -60.0), (2.0, -200.0),
    ]
)  # fmt: skip
"""Points on the car's way: in from the south, round on the outer lane, out to the north (m)."""
WAY_LENGTH = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(WAY, axis=0).T))])
PLANS = np.array(list(itertools.product((FASTER, KEEP, SLOWER), repeat=PLANNED)))
RING_M = 28.0
"""Cars nearer to the centre than this go round; those further out come straight in."""
SCALE = np.array([100.0, 100.0, 15.0, 15.0])


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.chosen = 1
        """Notch of the speed that was chosen last; the car starts at 8 m/s."""
        self.cars = []
        """Every car as last seen or forecast: (state, seconds since it was seen)."""

    def act(self, obs):
        rows = obs[:, 1:5] * SCALE
        self.remember(rows[1:][obs[1:, 0] > 0])
        speed = float(np.hypot(rows[0, 2], rows[0, 3]))
        best = PLANS[int(np.argmax(self.worth(way_done(rows[0, :2]), speed)))]
        self.chosen = int(notch_after(best[0], speed, self.chosen))
        return int(best[0])

    def remember(self, seen):
        """Take in the cars that are shown; of those that are not, keep a forecast for a while."""
        forecast = [(advance(state, 1.0), age + 1) for state, age in self.cars if age < FORGET_S]
        hidden = [
            (state, age)
            for state, age in forecast
            if all(np.hypot(*(state[:2] - car[:2])) > 6.0 for car in seen)
        ]
        self.cars = [(car, 0) for car in seen] + hidden

    def worth(self, done, speed):
        """What each plan earns until the horizon; `done` is the way behind the car in metres."""
        place = np.full(len(PLANS), done)
        speed = np.full(len(PLANS), speed)
        notch = np.full(len(PLANS), self.chosen)
        total = np.zeros(len(PLANS))
        cars = np.array([state for state, _ in self.cars])
        for second in range(HORIZON_S):
            choice = PLANS[:, second] if second < PLANNED else FASTER
            notch = notch_after(choice, speed, notch)
            total += SPEED_REWARD * notch
            for _ in range(SLICES):
                speed = speed + (SPEEDS[notch] - speed) / RESPONSE_S / SLICES
                place = place + speed / SLICES
                if len(cars) == 0:
                    continue
                cars = advance(cars, 1 / SLICES)
                x, y = np.interp(place, WAY_LENGTH, WAY[:, 0]), np.interp(place, WAY_LENGTH, WAY[:, 1])
                gap = np.hypot(x[:, None] - cars[:, 0], y[:, None] - cars[:, 1]).min(axis=1)
                total -= DANGER / SLICES * np.maximum(0.0, 1 - gap / DANGER_M)
                total -= CAUTION / SLICES * np.maximum(0.0, 1 - gap / CAUTION_M)
        return total


def notch_after(choice, speed, notch):
    """Notch that is chosen after a choice: counted from the actual speed, unless it is to be kept."""
    actual = np.rint(np.clip(speed / 8.0, 0, 2)).astype(int)
    faster, slower = np.minimum(actual + 1, 2), np.maximum(actual - 1, 0)
    return np.where(choice == FASTER, faster, np.where(choice == SLOWER, slower, notch))


def way_done(position):
    """How much of its way the car at this position has behind it (m)."""
    along = np.arange(0.0, WAY_LENGTH[-1], 0.5)
    x, y = np.interp(along, WAY_LENGTH, WAY[:, 0]), np.interp(along, WAY_LENGTH, WAY[:, 1])
    return float(along[np.argmin(np.hypot(x - position[0], y - position[1]))])


def advance(cars, seconds):
    """Forecast of cars, rows of (x, y, vx, vy), at constant speed: round the centre, or straight on outside."""
    x, y, vx, vy = cars[..., 0], cars[..., 1], cars[..., 2], cars[..., 3]
    radius = np.maximum(np.hypot(x, y), 1.0)
    going_round = (radius < RING_M) & (np.abs(x * vy - y * vx) > 0.5 * radius * np.hypot(vx, vy))
    turn = np.where(going_round, np.sign(x * vy - y * vx) * np.hypot(vx, vy) / radius * seconds, 0.0)
    cosine, sine = np.cos(turn), np.sin(turn)
    straight_x, straight_y = x + vx * seconds, y + vy * seconds
    return np.stack(
        [
            np.where(going_round, cosine * x - sine * y, straight_x),
            np.where(going_round, sine * x + cosine * y, straight_y),
            cosine * vx - sine * vy,
            sine * vx + cosine * vy,
        ],
        axis=-1,
    )
