"""The live view in a real browser, over a real cluster: a sweep is watched from start to end, whatever dies
meanwhile."""

from __future__ import annotations

import os
import signal
import sys
import urllib.request
from pathlib import Path

import pytest
from browser import Page
from commands import AGENT, command, process
from coordinator_harness import Coordinator
from machines.own_certs import free_port
from waiting import TIMEOUT_S, wait_until

from evopolicy_coordinator.web.access import kept_token

pytestmark = [pytest.mark.system, pytest.mark.slow]

SUITE = """
name = "watched"
environments = ["toy/line"]
[defaults]
repeats = 2
budget = {budget}
validation = 1
heldout = 1
[parallel]
machine = 1
[[agents]]
name = "<b>careful"
agent = "command:{python} {agent}"
[agents.jail]
read = ["{agent}"]
"""
WAITS = """
def wait_for(name):
    while not os.path.exists(name):
        time.sleep(0.05)

submit("0")
"""
TEXT = "(document.body?.innerText ?? '')"
LIVE = "document.getElementById('live')"


class Sweep:
    """A suite of one agent and two repeats, a coordinator, and the programs of a worker, view and suite."""

    def __init__(self, folder: Path, code: str, budget: int, *options: str) -> None:
        program, suite = folder / "agent.py", folder / "suite.toml"
        program.write_text(AGENT + WAITS + code)
        suite.write_text(SUITE.format(budget=budget, python=sys.executable, agent=program))
        self.folder, self.runs, self.log = folder, folder / "runs", folder / "log"
        self.runs.mkdir()
        self.token = kept_token(folder / "token")
        self.options = ("--hidden-isolation", "off", *options)
        self.coordinator = Coordinator(folder / "s", *self.options)
        joins, operator = (self.coordinator.ready["credentials"][role] for role in ("worker", "operator"))
        self.works = ("evopolicy_worker.cli", "--env", "toy", "--grace", "0", "--credentials", joins)
        operates = ("--credentials", operator)
        self.shows = ("evopolicy_gateway.cli", "web", str(self.runs), *operates)
        self.shows += ("--token-file", str(folder / "token"))
        self.plays = ("suite", str(suite), "--runs", str(self.runs / "watched"), *operates)

    def workspaces(self) -> list[Path]:
        return sorted((self.runs / "watched").glob("*/*/*/workspace"))


def done(workspace: Path) -> int:
    return len(list(workspace.glob("feedback/submit_*/summary.json")))


def answer(url: str) -> str:
    """What is at an address; nothing if nobody answers."""
    try:
        with urllib.request.urlopen(url, timeout=5) as response:
            return response.read().decode()
    except OSError:
        return ""


def rows(cell: str) -> str:
    return f"[...document.querySelectorAll('#run-rows {cell}')]"


@pytest.mark.timeout(600)
def test_a_sweep_is_watched_from_start_to_end(tmp_path: Path) -> None:
    web = f"127.0.0.1:{free_port()}"
    code = 'print("<i>I saw</i> the first return", flush=True)\nwait_for("go")\nsubmit("1-2")\n'
    sweep = Sweep(tmp_path, code, 3)
    works, shows = (*sweep.works, "--slots", "2"), (*sweep.shows, "--http", web)
    hidden = f"{rows('tr')}.some((row) => row.innerText.includes('hidden'))"
    fact = "document.querySelector('#facts b')?.textContent.startsWith"
    away = "document.querySelector('#notices')?.innerText.includes('does not answer')"
    try:
        with (
            process(sweep.log, *works) as worker,
            process(sweep.log, *shows) as view,
            Page(timeout_s=120) as page,
        ):
            wait_until(lambda: answer(f"http://{web}/healthz") == "ok\n")
            page.visit(f"http://{web}/login#token={sweep.token}")
            page.until(f"document.title === 'runs' && {LIVE}?.textContent === 'live'")
            assert page.run("location.hash") == ""
            assert page.run("document.cookie") == "", "scripts see no cookie"
            with command(tmp_path, *sweep.plays) as played:
                # The page has been open since before the sweep began: its rows come by themselves.
                wait_until(sweep.workspaces, lambda: played.text)
                page.until(f"{TEXT}.includes('watched') && {TEXT}.includes('training')")
                assert "<b>careful" in page.run(TEXT)
                page.until(f"{rows('tr')}.length === 2")
                page.until(f"{rows('tr td:nth-child(7)')}[0]?.textContent === '1'")
                assert page.violations() == []
                page.visit(page.run(f"{rows('a')}[0].href"))
                page.until("document.querySelectorAll('#submit-rows tr').length === 1")
                page.until("document.getElementById('messages')?.innerText.includes('<i>I saw</i>')")
                assert page.violations() == []
                (first,) = sweep.workspaces()

                # A worker is killed and comes back.
                page.visit(f"http://{web}/cluster")
                page.until("document.querySelector('#worker-rows td:nth-child(3)')?.textContent === 'active'")
                assert page.violations() == []
                assert page.problems == []
                os.kill(worker.pid, signal.SIGKILL)
                page.until(f"{fact}('1 of 1') === false")
                with process(sweep.log, *works):
                    page.until(f"{fact}('1 of ')")

                    # The coordinator restarts, and the page says so meanwhile.
                    sweep.coordinator.kill()
                    page.until(away)
                    sweep.coordinator = Coordinator(tmp_path / "s", *sweep.options)
                    page.until(f"{away} === false")
                    assert page.problems == []

                    # The view restarts, and the page reconnects by itself.
                    view.terminate()
                    view.wait(timeout=TIMEOUT_S)
                    page.until(f"{LIVE}?.dataset.state === 'away'")
                    with process(sweep.log, *shows):
                        wait_until(lambda: answer(f"http://{web}/healthz") == "ok\n")
                        page.until(f"{LIVE}?.dataset.state === 'live'")
                        page.problems.clear()

                        # The first run is scored while the second one's agent is alive: its scores are hidden
                        # until that ends.
                        page.visit(f"http://{web}/")
                        (first / "go").touch()
                        wait_until(lambda: sum(map(done, sweep.workspaces())) == 3, lambda: played.text)
                        wait_until(lambda: [*first.parent.glob("run.json")], lambda: played.text)
                        page.until(hidden)
                        for folder in sweep.workspaces():
                            (folder / "go").touch()
                        assert played.wait() == 0, played.err
                        page.until(f"{fact}('2 of 2')")
                        page.until(f"!{hidden}")
                        scores = page.run(f"{rows('td:nth-child(9)')}.map((cell) => cell.textContent)")
                        assert all(float(score.replace("−", "-")) for score in scores), scores
                        page.visit(page.run(f"{rows('a')}[0].href"))
                        page.visit(page.run("document.querySelector('#submit-rows a').href"))
                        assert "What changed in the code" in page.run(TEXT)
                        assert page.violations() == []
                        page.visit(page.run("document.querySelector('a[href*=\"/episode/\"]').href"))
                        assert page.run("document.querySelectorAll('figure svg[role=img]').length") >= 2
                        assert page.violations() == []
                        for width, dark in ((1280, True), (390, False)):
                            page.look(width=width, dark=dark, phone=width < 500)
                            page.visit(f"http://{web}/")
                            assert page.violations() == []
                            assert page.run("document.documentElement.scrollWidth <= innerWidth")
                        assert page.problems == []
    finally:
        sweep.coordinator.stop()
