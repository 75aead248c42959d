"""Errands in a MiniGrid world where one thing at a time can be carried: fetch, open, put down out of the way.

Each function returns a plan, (poses to pass, what to do at the last of them), or None when the errand cannot
be done from what is known.
"""

from gridmap import DOOR, DROP, EMPTY, LEFT, LOCKED, PICK_UP, STEP, trace

SEARCHED = 6
"""Steps within which a place to put something down is looked for, once one is found."""


def fetch(world, thing):
    """Go to what lies in a cell and pick it up. The hands must be empty."""
    route = world.route_facing(thing)
    return None if route is None else (route, PICK_UP)


def go_through(world, door):
    """Open a door on the way into it."""
    route = world.route_onto(door)
    return (route, LEFT) if route else None


def look_around(world):
    """Go where most is unseen."""
    route = world.route_to_news()
    return (route, LEFT) if route else None


def put_down(world, then=None):
    """Drop what is carried where it costs least, counting the way from there to face the cell `then`.

    Not into the doorways, nor right before or behind a door, where it would be in the way.
    """
    before, best, choice = {}, None, None
    for cost, cell, direction, previous in world.poses():
        before[cell, direction] = previous
        if best is not None and cost >= min(best, SEARCHED):
            break
        place = cell + STEP[direction]
        if world.kind[place] != EMPTY or any(world.kind[place + step] == DOOR for step in STEP):
            continue
        onward = 0 if then is None else cost_to_face(world, then, (cell, direction), place)
        if onward is not None and (best is None or cost + onward < best):
            best, choice = cost + onward, (cell, direction)
    return (trace(before, choice), DROP) if choice else None


def cost_to_face(world, thing, start, blocked):
    """Steps from a pose until `thing` is right ahead, with one more cell blocked; None if there is no way."""
    for cost, cell, direction, _ in world.poses({blocked}, start):
        if cell + STEP[direction] == thing:
            return cost
    return None


def locked_doors(world):
    """Locked doors that are known."""
    return world.find(DOOR, state=LOCKED)
