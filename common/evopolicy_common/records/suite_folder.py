"""Names of files in a sweep's folder that several rooms use."""

from __future__ import annotations

INDEX = "suite.json"
"""State of the sweep, run by run."""
PAUSED = "paused"
"""While this file exists, no host that shares the folder starts another run of the sweep."""
