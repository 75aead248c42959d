"""Bipedal walker: a step is three phases, and then the legs change roles.

Swing: the body tips forward over the standing leg while the other leg, its knee bent, is brought forward.
Land: the swung leg is lowered until it touches the ground. Push: the leg that is now behind straightens its
knee and shoves the body on; then it becomes the one that swings. Each phase wants certain angles of hips and
knees; springs and dampers draw the joints to them, the hips also hold the hull upright, and the knees damp
its bobbing. The numbers were tuned together by evolution (CMA-ES) on the return, from a guess that fell in
half of its episodes.
"""

import numpy as np

SWING, LAND, PUSH = range(3)

# Angles in rad, of knees as they are observed: 0.9 is straight, less is bent.
SWING_HIP, SWING_KNEE = 1.406, -0.695
LAND_HIP, LAND_KNEE = 0.120, 0.146
STAND_KNEE = 0.096
STAND_KNEE_RISE = 0.03
"""How fast the standing knee, which gave way on landing, comes up to `STAND_KNEE` (rad per step)."""
PUSH_KNEE = 0.854

HIP_BEHIND = 0.103
"""The swung leg is lowered once the standing leg's hip is back to this."""
PUSHED_KNEE = 0.629
"""The push is over when its knee is this straight,"""
PUSHED_SPEED = 0.322
"""or when the hull is this fast (as observed: 0.12 times m/s)."""

POWER = 0.567
HIP_SPRING, HIP_DAMPER = 0.714, 0.246
KNEE_SPRING, KNEE_DAMPER = 3.539, 0.235
UPRIGHT_SPRING, UPRIGHT_DAMPER = 0.862, 1.594
BOB_DAMPER = 10.20

HIP, HIP_SPEED, KNEE, KNEE_SPEED, CONTACT = range(5)
"""What is observed of a leg."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.phase = SWING
        self.swinging = 0
        """Which leg swings; the other one stands."""
        self.stand_knee = STAND_KNEE

    def act(self, obs):
        tilt, tilt_speed, speed, rise = obs[:4]
        legs = obs[4:14].reshape(2, 5)
        swing, stand = legs[self.swinging], legs[1 - self.swinging]
        swing_hip, swing_knee, stand_knee = self.wanted_angles(swing, stand)

        upright = UPRIGHT_SPRING * tilt + UPRIGHT_DAMPER * tilt_speed
        torques = np.empty((2, 2))
        for leg, hip, knee in ((self.swinging, swing_hip, swing_knee), (1 - self.swinging, None, stand_knee)):
            angles = legs[leg]
            torques[leg, 0] = upright
            if hip is not None:
                torques[leg, 0] += HIP_SPRING * (hip - angles[HIP]) - HIP_DAMPER * angles[HIP_SPEED]
            torques[leg, 1] = KNEE_SPRING * (knee - angles[KNEE]) - KNEE_DAMPER * angles[KNEE_SPEED]
            torques[leg, 1] -= BOB_DAMPER * rise

        if self.phase == PUSH and (stand[KNEE] > PUSHED_KNEE or speed > PUSHED_SPEED):
            self.phase, self.swinging = SWING, 1 - self.swinging
        return np.clip(POWER * torques.ravel(), -1.0, 1.0)

    def wanted_angles(self, swing, stand):
        """Wanted angles of the swinging hip (None: only hold the hull), the swinging and the standing knee; passes
        on to the next phase where that is due."""
        if self.phase == SWING and stand[HIP] < HIP_BEHIND:
            self.stand_knee = min(self.stand_knee + STAND_KNEE_RISE, STAND_KNEE)
            self.phase = LAND
        if self.phase == LAND and swing[CONTACT]:
            self.stand_knee = min(swing[KNEE], STAND_KNEE)
            self.phase = PUSH
        if self.phase == SWING:
            stand_knee = self.stand_knee
            self.stand_knee = min(self.stand_knee + STAND_KNEE_RISE, STAND_KNEE)
            return SWING_HIP, SWING_KNEE, stand_knee
        if self.phase == LAND:
            return LAND_HIP, LAND_KNEE, self.stand_knee
        # The leg that has just landed now bears the weight; the one behind it pushes.
        return None, self.stand_knee, PUSH_KNEE
