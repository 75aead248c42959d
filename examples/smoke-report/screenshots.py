"""Screenshots of a report or of a live view in a headless Chromium, small enough to be kept:
docs/how-to/reports.md shows them.

PYTHONPATH=tests/support python examples/smoke-report/screenshots.py REPORT|ADDRESS OUT

ADDRESS is what `evopolicy web` prints, of a view with a cluster and a run that has several submits.
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
TO_SECTION = """(() => { const e = document.querySelector(%r);
  e.querySelectorAll(':scope > details').forEach((one) => { one.open = true; }); e.scrollIntoView();
  window.scrollBy(0, -8); return e.id; })()"""
VIDEOS = """Promise.all([...document.querySelectorAll('video')].map((video) => new Promise((done) => {
  video.preload = 'auto';
  video.controls = false;
  video.addEventListener('seeked', () => done(video.videoWidth));
  video.addEventListener('error', () => done(0));
  video.addEventListener('loadeddata', () => { video.currentTime = video.duration / 2; });
  video.load();
})))"""


MOST_SUBMITS = """[...document.querySelectorAll('#run-rows tr')].sort((a, b) =>
  b.children[6].textContent - a.children[6].textContent)[0].querySelector('a').href"""


def shoot(page: Page, out: Path) -> None:
    """The window as it is now."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        page.screenshot(Path(file.name))
        image = Image.open(io.BytesIO(Path(file.name).read_bytes())).convert("RGB")
    image.save(out, optimize=True)
    print(f"{out}: {out.stat().st_size >> 10} KiB")


def report_pages(page: Page, report: Path, out: Path) -> None:
    """Front page in light, dark and on a phone; its sections; a run's page, and a replays page if there is one."""
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


def view_pages(page: Page, address: str, out: Path) -> None:
    """All runs, one run and the cluster in the dark, all runs on a phone."""
    base, run = address.partition("/login")[0], ""
    for name, place, look in (
        ("web-runs", address, {"width": 1280, "height": 1000}),
        ("web-run-dark", "", {"width": 1280, "height": 1300, "dark": True}),
        ("web-cluster-dark", f"{base}/cluster", {"width": 1280, "height": 1300, "dark": True}),
        ("web-phone", f"{base}/", {"width": 390, "height": 844, "phone": True}),
    ):
        page.look(**look)
        page.visit(place or run)
        page.until("document.getElementById('live')?.textContent === 'live'")
        shoot(page, out / f"{name}.png")
        run = run or page.run(MOST_SUBMITS)


def main() -> None:
    """Takes them all."""
    source, out = sys.argv[1], Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    with Page() as page:
        if source.startswith("http"):
            view_pages(page, source, out)
        else:
            report_pages(page, Path(source), out)
        assert page.problems == [], page.problems


if __name__ == "__main__":
    main()
