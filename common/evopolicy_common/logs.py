"""structlog as all modules import it: without rich, whose import would take a fifth of the time in which a process of
ours starts.

structlog takes rich, where it is installed, to draw tracebacks; ours are text before its renderers see them.
"""

from __future__ import annotations

import sys

if "rich" in sys.modules:
    import structlog
else:
    sys.modules["rich"] = None  # type: ignore[assignment]  # an import of it fails
    try:
        import structlog
    finally:
        del sys.modules["rich"]

__all__ = ["log", "structlog"]

log: structlog.stdlib.BoundLogger = structlog.get_logger()
"""The logger of all modules; `setup_logging` decides what becomes of its lines."""
