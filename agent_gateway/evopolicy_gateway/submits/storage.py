"""Observations as NumPy files: `observations.npy` for one array a step, `observations.npz` for dicts and tuples.

Row t holds what the policy received at step t. The same observations give the same bytes: members have no times.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.records.columns import leaves

MIN_PICTURE_SIDE = 16
"""Height × width × channels of bytes is a picture from this side on; smaller ones are symbols."""


def npy_bytes(array: NDArray[Any]) -> bytes:
    """One array, format version 1.0 or later, C order."""
    out = io.BytesIO()
    np.lib.format.write_array(out, np.ascontiguousarray(array), allow_pickle=False)
    return out.getvalue()


def npz_bytes(arrays: dict[str, NDArray[Any]]) -> bytes:
    """Named arrays, deflated; read them with `numpy.load`."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")  # dated 1980 whatever the clock says
            member.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(member, npy_bytes(array), compresslevel=1)
    return out.getvalue()


def named_columns(columns: Any) -> dict[str, NDArray[Any]]:
    """The leaves of `Trajectory.obs` by name, first axis the step; texts become arrays of unicode.

    A leaf is named by its path, see `columns.leaves`.
    """
    return {path: _array(leaf) for path, leaf in leaves(columns)}


def storage_for(columns: Any) -> ObsStorage:
    """Where these columns belong: beside the rows where there is a picture among them."""
    found = dict(leaves(columns))
    if not any(_is_pictures(leaf) for leaf in found.values()):
        return "inline"
    return "npy" if list(found) == [""] else "npz"


def _is_pictures(leaf: Any) -> bool:
    shape = leaf.shape[1:] if isinstance(leaf, np.ndarray) and leaf.dtype == np.uint8 else ()
    return len(shape) == 3 and min(shape[:2]) >= MIN_PICTURE_SIDE


def _array(leaf: Any) -> NDArray[Any]:
    if isinstance(leaf, np.ndarray):
        return leaf
    return np.array(leaf, dtype=np.str_ if all(isinstance(item, str) for item in leaf) else None)
