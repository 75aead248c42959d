"""Names in a sweep's folder that several rooms know."""

from __future__ import annotations

INDEX = "suite.json"
"""What the sweep has come to, run by run."""
PAUSED = "paused"
"""While this file is there, no further run of the sweep begins, on any host that shares the folder."""
