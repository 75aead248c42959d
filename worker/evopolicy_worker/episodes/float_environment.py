"""The processor's float settings: rounding, and whether tiny numbers are kept or taken for zero.

Rule: every episode begins with the C language's defaults. A library that was compiled for speed may change them for the
whole process when it is loaded, and an episode must not depend on which others were played before it.
"""

from __future__ import annotations

import ctypes

_DEFAULT = ctypes.c_void_p(-1)
"""C's FE_DFL_ENV."""

_set = ctypes.CDLL(None).fesetenv


def reset() -> None:
    """Round to nearest, keep subnormal numbers, trap nothing: in the calling thread."""
    _set(_DEFAULT)
