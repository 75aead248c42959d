"""Steers towards the lane's middle and along its heading."""

SEEN = {
    "state[0, 0]": "y of the car",
    "state[1, 0]": "heading, from the x axis towards the y axis",
    "state[3, 0]": "turning rate",
    "reference_state[0, 0]": "y of the lane's middle beside the car",
    "reference_state[1, 0]": "heading of the lane there",
}
DONE = {"0": "steering angle; positive turns the heading from x towards y, to the right"}


def act(seen):
    y, heading, turning, middle, lane = seen
    wanted = lane + max(-0.5, min(0.5, 0.15 * (middle - y)))
    return [max(-1.0, min(1.0, 0.6 * (wanted - heading) - 0.1 * turning))]
