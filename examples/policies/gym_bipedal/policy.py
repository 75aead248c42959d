"""Bipedal walker: a step is three phases, and then the legs change roles.

Swing: the body leans over the standing leg while the other leg, its knee bent, is brought forward. Land: the swung leg
is straightened and lowered until it touches the ground. Push: the leg that is now behind straightens its knee and gives
the body a push; then it becomes the one that swings. Each phase wants certain angles of hips and knees; springs and
dampers draw the joints to them, the hips also keep the hull upright, and the knees damp its bobbing. The numbers were
tuned together by evolution (CMA-ES) from a guess.
"""

import numpy as np

SWING, LAND, PUSH = range(3)

PARAMETERS = {
    "swing_hip": 1.1,
    "swing_knee": -0.6,
    "land_hip": 0.1,
    "stand_knee": 0.1,
    "lean": 0.1,
    "push_knee": 1.0,
    "push_end_knee": 0.88,
    "speed": 0.29,
    "hip_spring": 0.9,
    "hip_damper": 0.25,
    "knee_spring": 4.0,
    "knee_damper": 0.25,
    "upright_spring": 0.9,
    "upright_damper": 1.5,
    "bob_damper": 15.0,
    "power": 0.5,
    "land_knee": 0.1,
    "push_hip": 0.0,
}


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.p = PARAMETERS
        self.reset(0)

    def reset(self, episode_index):
        self.phase = SWING
        self.swinging = 0
        self.stand_knee = self.p["stand_knee"]
        self.steps = 0

    def act(self, obs):
        p = self.p
        legs = obs[4:14].reshape(2, 5)
        """Per leg: hip angle, hip speed, knee angle + 1, knee speed, contact."""
        swing, stand = legs[self.swinging], legs[1 - self.swinging]
        self.steps += 1
        if self.phase == SWING and (stand[0] < p["lean"] or self.steps > 60):
            self.enter(LAND)
        elif self.phase == LAND and (swing[4] or self.steps > 40):
            self.enter(PUSH)
            self.stand_knee = min(swing[2], p["stand_knee"])
        elif self.phase == PUSH and (stand[2] > p["push_end_knee"] or obs[2] > 1.2 * p["speed"] or self.steps > 40):
            self.enter(SWING)
            self.swinging = 1 - self.swinging
            swing, stand = stand, swing
        if self.phase == SWING:
            self.stand_knee = min(self.stand_knee + 0.02, p["stand_knee"])
            hips, knees = (p["swing_hip"], None), (p["swing_knee"], self.stand_knee)
        elif self.phase == LAND:
            hips, knees = (p["land_hip"], None), (p["land_knee"], self.stand_knee)
        else:
            hips, knees = (None, p["push_hip"]), (self.stand_knee, p["push_knee"])
        swing_hip = self.hip(hips[0], swing, obs)
        stand_hip = self.hip(hips[1], stand, obs)
        swing_knee = self.knee(knees[0], swing, obs)
        stand_knee = self.knee(knees[1], stand, obs)
        action = np.empty(4)
        first = 2 * self.swinging
        action[first : first + 2] = swing_hip, swing_knee
        action[2 - first : 4 - first] = stand_hip, stand_knee
        return np.clip(p["power"] * action, -1.0, 1.0)

    def enter(self, phase):
        self.phase, self.steps = phase, 0

    def hip(self, wanted, leg, obs):
        """Torque on a hip: to the wanted angle if there is one, and against the hull's tilt."""
        p = self.p
        torque = p["upright_spring"] * obs[0] + p["upright_damper"] * obs[1]
        if wanted is not None:
            torque += p["hip_spring"] * (wanted - leg[0]) - p["hip_damper"] * leg[1]
        return torque

    def knee(self, wanted, leg, obs):
        p = self.p
        return p["knee_spring"] * (wanted - leg[2]) - p["knee_damper"] * leg[3] - p["bob_damper"] * obs[3]
