"""Stands still on four legs, with little torque: each step upright pays."""

LEGS = (4, 1, 2, 3)
"""The legs in the order of the actions."""
SEEN = {
    at: words
    for leg in LEGS
    for at, words in (
        (f"{3 + 2 * leg}", f"hip angle of leg {leg}"),
        (f"{4 + 2 * leg}", f"ankle angle of leg {leg}"),
        (f"{17 + 2 * leg}", f"angular velocity of the hip of leg {leg}"),
        (f"{18 + 2 * leg}", f"angular velocity of the ankle of leg {leg}"),
    )
}
DONE = {
    f"{2 * place + k}": f"torque on the {joint} of leg {leg}"
    for place, leg in enumerate(LEGS)
    for k, joint in enumerate(("hip", "ankle"))
}


def act(seen):
    torques = []
    for place, leg in enumerate(LEGS):
        hip, ankle, swing, bend = seen[4 * place : 4 * place + 4]
        wanted = 0.9 if leg in (1, 4) else -0.9
        torques += [-0.3 * hip - 0.03 * swing, 0.3 * (wanted - ankle) - 0.03 * bend]
    return [max(-1.0, min(1.0, each)) for each in torques]
