"""Stands: holds the joints near straight against a lean of the torso."""

SEEN = {
    "1": "angle of the torso; positive leans forward",
    "2": "thigh angle; negative swings the leg backward",
    "3": "knee angle; negative swings the lower leg backward",
    "4": "foot angle; negative turns the toe down",
    "5": "velocity of the torso along x",
    "7": "angular velocity of the torso",
    "8": "angular velocity of the thigh",
    "9": "angular velocity of the knee",
    "10": "angular velocity of the foot",
}
DONE = {"0": "torque on the thigh", "1": "torque on the knee", "2": "torque on the foot"}


def act(seen):
    lean, thigh, knee, foot, speed, leaning, swing, bend, turn = seen
    tilt = lean + 0.3 * leaning + 0.1 * speed
    torques = (
        -2 * tilt - 2 * thigh - 0.1 * swing,
        -2 * (knee + 0.1) - 0.1 * bend,
        -4 * tilt - foot - 0.05 * turn,
    )
    return [max(-1.0, min(1.0, each)) for each in torques]
