"""Gymnasium's Box2D environments: walkers, landers, a racing car."""

from __future__ import annotations

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily


class Box2DFamily(GymnasiumFamily):
    distributions = ("gymnasium", "box2d", "pygame-ce")
    modules = ("gymnasium", "Box2D", "pygame")

    def rebuilds(self, entry: Entry) -> bool:
        # The Box2D world outlives `reset`, and the order of its contacts depends on what was in it before: a reused
        # walker falls differently. CarRacing's car does not touch anything, and repeats exactly.
        return not str(entry.gymnasium_id).startswith("CarRacing")


FAMILY = Box2DFamily()
