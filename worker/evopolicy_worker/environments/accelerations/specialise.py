"""One object's class exchanged for a subclass of it: the way in which accelerations replace methods.

Other objects of the library's class, and the class itself, stay as they are; `super()` reaches the library's method.
"""

from __future__ import annotations

from functools import cache
from typing import Any


def specialise(target: Any, mixin: Any) -> None:
    """Make `target` an instance of `mixin` in front of its present class, under that class's name."""
    target.__class__ = specialised(target.__class__, mixin)


@cache
def specialised(cls: Any, mixin: Any) -> Any:
    """`mixin` in front of `cls`, under the name of `cls`. The same pair gives the same class."""
    names = {"__module__": mixin.__module__, "__qualname__": cls.__qualname__}
    if _root(cls) is _root(mixin):
        return type(cls.__name__, (mixin, cls), names)
    # An object's class is exchanged for one of the same memory layout, which the first base determines.
    order = [each for each in mixin.__mro__ if each not in cls.__mro__] + list(cls.__mro__)
    kind = type("Ordered", (type(cls),), {"mro": lambda made: [made, *order]})
    return kind(cls.__name__, (cls,), names)


def _root(cls: Any) -> Any:
    return cls if cls.__base__ is object else _root(cls.__base__)
