"""Screenshots of a live view in a headless Chromium: docs/how-to/watch.md shows them.

PYTHONPATH=tests/support python examples/smoke-report/web_screenshots.py ADDRESS OUT

ADDRESS is what `evopolicy web` prints, of a view with a cluster and a run that has several submits.
"""

from __future__ import annotations

import sys
from pathlib import Path

from browser import Page
from screenshots import shoot

MOST_SUBMITS = """[...document.querySelectorAll('#run-rows tr')].sort((a, b) =>
  b.children[6].textContent - a.children[6].textContent)[0].querySelector('a').href"""


def main() -> None:
    """All runs, one run and the cluster in the dark, all runs on a phone."""
    address, out = sys.argv[1], Path(sys.argv[2])
    base = address.partition("/login")[0]
    with Page() as page:
        page.look(width=1280, height=1000)
        page.visit(address)
        page.until("document.getElementById('live')?.textContent === 'live'")
        shoot(page, out / "web-runs.png")
        run = page.run(MOST_SUBMITS)
        page.look(width=1280, height=1300, dark=True)
        for name, place in (("web-run-dark", run), ("web-cluster-dark", f"{base}/cluster")):
            page.visit(place)
            page.until("document.getElementById('live')?.textContent === 'live'")
            shoot(page, out / f"{name}.png")
        page.look(width=390, height=844, phone=True)
        page.visit(f"{base}/")
        page.until("document.getElementById('live')?.textContent === 'live'")
        shoot(page, out / "web-phone.png")
        assert page.problems == [], page.problems


if __name__ == "__main__":
    main()
