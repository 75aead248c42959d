"""Makes the shared test support importable."""

from __future__ import annotations

import sys
from pathlib import Path

SUPPORT = str(Path(__file__).resolve().parents[3] / "support")
if SUPPORT not in sys.path:
    sys.path.append(SUPPORT)
