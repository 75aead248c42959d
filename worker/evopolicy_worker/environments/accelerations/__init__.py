"""Faster ways to the same episode: small replacements of library functions where a simulator wastes its time.

Rules that this package owns:
- An acceleration changes no bit of any observation, reward, flag or `info`, and none of a rendered picture. Each module
  says which library function it replaces and why the result is the same. Where floating point is involved, either the
  library's own operations are made in the library's order, or a cheap estimate decides what *not* to compute, with a
  margin far above its error.
- It touches only the environment that it was given (`specialise` swaps the class of that one object for a subclass);
  library modules and classes stay as they are.
- It is used only with versions it was proved on (`PROVED`): with any other it stands aside, and says so once.
- `tests/conformance/environments/test_accelerations.py` compares each with the plain environment;
  `acceleration_checks.py` beside it does so for any number of seeds, with random actions and competent ones.

They are on by default; `make(env_id, accelerations=False)` or `EVOPOLICY_ACCELERATIONS=off` switches them off.
"""

from __future__ import annotations

from evopolicy_worker.environments.accelerations.table import (
    ACCELERATIONS,
    PROVED,
    Acceleration,
    accelerate,
    usable,
)

__all__ = ["ACCELERATIONS", "PROVED", "Acceleration", "accelerate", "usable"]
