"""The published service's answers to odd URLs and methods (v0.1.0), as tables. They apply in the published profiles."""

from __future__ import annotations

import html
from http.server import BaseHTTPRequestHandler

METHODS = ("GET", "POST")
"""Any other method gets `UNSUPPORTED`, whatever its URL."""
ODD_URLS: dict[tuple[str, str], tuple[int, str, str]] = {
    ("POST", "/finalize"): (405, "method_not_allowed", "a run is finalized by itself"),
}
"""Method and path to HTTP code, status and message; all others get `UNKNOWN_URL`, wrong methods of known paths too."""
UNKNOWN_URL = (404, "not_found", "unknown endpoint")


def unsupported(method: str) -> tuple[bytes, str]:
    """Body and content type of the answer 501 to a method. As published: that of Python's `http.server`."""
    message = html.escape(f"Unsupported method ({method!r})", quote=False)
    explain = "Server does not support this operation"
    page = BaseHTTPRequestHandler.error_message_format % {"code": 501, "message": message, "explain": explain}
    return b"" if method == "HEAD" else page.encode(), BaseHTTPRequestHandler.error_content_type
