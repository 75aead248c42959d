"""Accelerations: faster replacements of slow library functions that leave every episode the same.

Rules that this package owns:
- An acceleration changes no bit of any observation, reward, flag, `info` or rendered picture. Each module names the
  library function that it replaces and gives the reason why the result is the same. With floating point, it either does
  the library's own operations in the library's order, or uses a cheap estimate only to skip computations, with a margin
  far above the estimate's error.
- It changes only the given environment (`specialise` replaces the class of that one object by a subclass). Library
  modules and classes stay unchanged.
- It is used only with the versions it was proved on (`PROVED`). With any other it is off, and a warning is logged once.
- `tests/conformance/environments/test_accelerations.py` compares each with the plain environment.
  `acceleration_checks.py` beside it does so for any number of seeds, with random and with competent actions.

They are on by default; `make(env_id, accelerations=False)` or `EVOPOLICY_ACCELERATIONS=off` switches them off.
"""

from __future__ import annotations

from evopolicy_worker.environments.accelerations.table import ACCELERATIONS as ACCELERATIONS
from evopolicy_worker.environments.accelerations.table import accelerate as accelerate
from evopolicy_worker.environments.accelerations.table import off as off
