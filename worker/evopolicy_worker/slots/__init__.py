"""Slots, as the supervisor sees them: each plays one episode at a time on one core."""
