"""Steer the tilt by where the pad is, and the descent by the height: proportional and derivative terms, whichever is
larger acts."""

NOTHING, LEFT, MAIN, RIGHT = range(4)


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        x, y, vx, vy, tilt, spin, left_leg, right_leg = obs
        if left_leg or right_leg:
            return MAIN if vy < -0.1 else NOTHING
        wanted_tilt = max(-0.4, min(0.4, 0.5 * x + vx))
        turn = 0.5 * (wanted_tilt - tilt) - spin
        lift = 0.5 * (0.55 * abs(x) - y) - 0.5 * vy
        if lift > max(abs(turn), 0.05):
            return MAIN
        if turn < -0.05:
            return RIGHT
        return LEFT if turn > 0.05 else NOTHING
