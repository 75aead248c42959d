"""Smooths recorded signals with a biquad to find the gait's period."""
import json
import sys


def biquad(samples, b0, b1, b2, a1, a2):
    z1 = z2 = 0.0
    power = 0.0
    out = []
    for sample in samples:
        y = b0 * sample + z1
        z1 = b1 * sample - a1 * y + z2
        z2 = b2 * sample - a2 * y
        power += y * y
        out.append(y)
    return out, power


for path in sys.argv[1:]:
    rows = [json.loads(line) for line in open(path)]
    for channel in range(len(rows[0]["obs"])):
        smooth, power = biquad([row["obs"][channel] for row in rows], 0.02, 0.04, 0.02, -1.56, 0.64)
        crossings = sum(a < 0 <= b for a, b in zip(smooth, smooth[1:]))
        print(path, channel, crossings, round(power, 3))
