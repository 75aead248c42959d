"""Screenshots of a report in a headless Chromium, small enough to be kept: docs/how-to/reports.md shows them.

PYTHONPATH=tests/support python examples/smoke-report/screenshots.py REPORT OUT
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from browser import Page
from PIL import Image

PICK = """(() => { const p = document.getElementById('timeline-picker'); p.value = 'gym/racing';
  p.dispatchEvent(new Event('change')); })()"""
TO_SECTION = """(() => { const e = document.querySelector(%r); e.scrollIntoView();
  window.scrollBy(0, -8); return e.id; })()"""
VIDEOS = """Promise.all([...document.querySelectorAll('video')].map((video) => new Promise((done) => {
  video.preload = 'auto';
  video.controls = false;
  video.addEventListener('seeked', () => done(video.videoWidth));
  video.addEventListener('error', () => done(0));
  video.addEventListener('loadeddata', () => { video.currentTime = video.duration / 2; });
  video.load();
})))"""


def shoot(page: Page, out: Path) -> None:
    """The window as it is now."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        page.screenshot(Path(file.name))
        image = Image.open(io.BytesIO(Path(file.name).read_bytes())).convert("RGB")
    image.save(out, optimize=True)
    print(f"{out}: {out.stat().st_size >> 10} KiB")


def main() -> None:
    """Front page in light, dark and on a phone; its sections; a run's page, and a replays page if there is one."""
    report, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    with Page() as page:
        page.look(width=1280, height=1000)
        page.open(report / "index.html")
        for name, dark in (("report-light", False), ("report-dark", True)):
            page.look(width=1280, height=1000, dark=dark)
            shoot(page, out / f"{name}.png")
        page.look(width=1280, height=1000)
        for section in ("evolution", "demand", "edits", "timelines", "cost"):
            page.run(PICK)
            page.run(TO_SECTION % f"section[id^={section}], section[aria-labelledby^={section}]")
            shoot(page, out / f"report-{section}.png")
        page.look(width=390, height=844, phone=True)
        page.open(report / "index.html")
        shoot(page, out / "report-phone.png")
        page.look(width=1280, height=690)
        replays = report / "replays" / "gym-racing.html"
        if replays.is_file():
            page.open(replays)
            assert all(page.run(VIDEOS))
            page.run("new Promise((done) => setTimeout(done, 500))")  # the frames are painted
            shoot(page, out / "report-replays.png")
        trace = min((report / "traces").glob("gym-racing-*.html"))
        page.look(width=1280, height=1400)
        page.open(trace)
        shoot(page, out / "report-trace.png")
        assert page.problems == [], page.problems


if __name__ == "__main__":
    main()
