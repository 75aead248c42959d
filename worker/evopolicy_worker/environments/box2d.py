"""Gymnasium's Box2D environments: BipedalWalker, CarRacing."""

from __future__ import annotations

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.gymnasium_adapter import GymnasiumFamily


class Box2DFamily(GymnasiumFamily):
    """A walker and a racing car."""

    distributions = ("gymnasium", "box2d", "pygame-ce")
    modules = ("gymnasium", "Box2D", "pygame")

    def rebuilds(self, entry: Entry) -> bool:
        # The Box2D world outlives `reset`, and the order of its contacts depends on what was in it before: a reused
        # walker falls differently. CarRacing's car does not touch anything, and repeats exactly.
        return str(entry.gymnasium_id).startswith("BipedalWalker")


FAMILY = Box2DFamily()
