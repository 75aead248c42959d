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
    return type(
        cls.__name__, (mixin, cls), {"__module__": mixin.__module__, "__qualname__": cls.__qualname__}
    )
