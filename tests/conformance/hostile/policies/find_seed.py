"""Walks all objects, frames and memory it can reach for the case's seed, and tries it against its generators."""
import gc, json, random, struct, sys
import numpy as np
MASK = 0x5A5A5A5A
MASKED = json.load(open("target.json"))["masked_seed"]
# The seed itself is never kept: only what is found counts.

def reachable():
    seen, stack = set(), [sys._getframe(), *gc.get_objects(), *sys.modules.values()]
    frame = sys._getframe()
    while frame:
        stack += [frame.f_locals, frame.f_globals]
        frame = frame.f_back
    while stack and len(seen) < 400_000:
        item = stack.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        yield item
        if isinstance(item, (dict, list, tuple, set)) or hasattr(item, "__dict__"):
            stack += gc.get_referents(item)

def holds(item):
    seed = MASKED ^ MASK
    if isinstance(item, int):
        return int(item) == seed
    if isinstance(item, (bytes, bytearray)):
        return any(struct.pack(form, seed) in item for form in ("<Q", ">Q", "<I", ">I")) or str(seed).encode() in item
    if isinstance(item, str):
        return str(seed) in item
    return False

def walk():
    return [type(item).__name__ for item in reachable() if holds(item)]

def generator():
    return random.getstate() == random.Random(MASKED ^ MASK).getstate()

def numpy_generator():
    here = np.random.get_state()[1]
    return bool((here == np.random.RandomState(MASKED ^ MASK).get_state()[1]).all())

def attempts():
    yield "in an object", walk
    yield "in random's state", generator
    yield "in numpy's state", numpy_generator
