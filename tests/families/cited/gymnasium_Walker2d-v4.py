"""Stands: holds the joints of both legs near straight, one leg a little before the other."""

SEEN = {
    "1": "angle of the torso; positive leans forward",
    "2": "right thigh angle; negative swings the leg backward",
    "3": "right knee angle; negative swings the lower leg backward",
    "4": "right foot angle; negative turns the toe down",
    "5": "left thigh angle",
    "6": "left knee angle",
    "7": "left foot angle",
    "10": "angular velocity of the torso",
    "11": "angular velocities of right thigh, knee and foot",
    "12": "angular velocities of right thigh, knee and foot",
    "13": "angular velocities of right thigh, knee and foot",
    "14": "angular velocities of left thigh, knee and foot",
    "15": "angular velocities of left thigh, knee and foot",
    "16": "angular velocities of left thigh, knee and foot",
}
DONE = {
    "0": "torque on the right thigh",
    "1": "torque on the right knee",
    "2": "torque on the right foot",
    "3": "torque on the left thigh",
    "4": "torque on the left knee",
    "5": "torque on the left foot",
}


def act(seen):
    lean, leaning, angles, speeds = seen[0], seen[7], seen[1:7], seen[8:]
    wanted = (0.0, -0.1, 0.0, -0.3, -0.1, 0.0)
    held = [
        3 * (want - angle) - 0.15 * speed for want, angle, speed in zip(wanted, angles, speeds, strict=True)
    ]
    for foot in (2, 5):
        held[foot] -= 3 * lean + 0.6 * leaning
    return [max(-1.0, min(1.0, each)) for each in held]
