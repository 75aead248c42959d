"""Slots: one core's worth of episodes each, as the supervisor sees them."""
