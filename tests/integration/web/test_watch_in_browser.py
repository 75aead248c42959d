"""The live view in a real browser, over a real cluster: a sweep is watched from its start to its end, whatever dies
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

from evopolicy_coordinator.web.access import kept_tokens

pytestmark = pytest.mark.system

SUITE = """
name = "watched"
environments = ["toy/line"]
[defaults]
repeats = 2
budget = 3
validation = 1
heldout = 1
[parallel]
machine = 1
[[agents]]
name = "<b>careful"
agent = "command:{python} {agent}"
[agents.jail]
read = ["{folder}"]
"""
PATIENT = """
def wait_for(name):
    while not os.path.exists(name):
        time.sleep(0.05)

submit("0")
print("<i>I saw</i> the first return", flush=True)
wait_for("go")
submit("1-2")
"""
TEXT = "(document.body?.innerText ?? '')"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_sweep_is_watched_from_start_to_end(tmp_path: Path) -> None:
    (tmp_path / "agent.py").write_text(AGENT + PATIENT)
    (tmp_path / "suite.toml").write_text(
        SUITE.format(python=sys.executable, agent=tmp_path / "agent.py", folder=tmp_path / "agent.py")
    )
    runs, metrics, web = tmp_path / "runs", free_port(), free_port()
    runs.mkdir()
    options = ("--hidden-isolation", "off", "--metrics", f"127.0.0.1:{metrics}")
    coordinator = Coordinator(tmp_path / "s", *options)
    operator, joins = coordinator.ready["credentials"]["operator"], coordinator.ready["credentials"]["worker"]
    works = ("evopolicy_worker.cli", "--env", "toy", "--slots", "2", "--grace", "0", "--credentials", joins)
    shows = (
        "evopolicy_gateway.cli",
        "web",
        str(runs),
        "--credentials",
        operator,
        "--http",
        f"127.0.0.1:{web}",
    )
    shows += ("--token-file", str(tmp_path / "tokens"))
    log = tmp_path / "log"
    token = kept_tokens(tmp_path / "tokens").read
    plays = (
        "suite",
        str(tmp_path / "suite.toml"),
        "--runs",
        str(runs / "watched"),
        "--credentials",
        operator,
    )

    def workspaces() -> list[Path]:
        return sorted((runs / "watched").glob("*/*/*/workspace"))

    def answers() -> bool:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{web}/healthz", timeout=5) as answer:
                return bool(answer.read() == b"ok\n")
        except OSError:
            return False

    try:
        with process(log, *works) as worker, process(log, *shows) as view, Page(timeout_s=120) as page:
            wait_until(answers)
            page.visit(f"http://127.0.0.1:{web}/login#token={token}")
            page.until("document.title === 'runs' && document.getElementById('live')?.textContent === 'live'")
            assert page.run("location.hash") == ""
            assert page.run("document.cookie") == "", "scripts see no cookie"
            with command(tmp_path, *plays) as sweep:
                # The page has been open since before the sweep began: its rows come by themselves.
                wait_until(workspaces, lambda: sweep.text)
                page.until(f"{TEXT}.includes('watched') && {TEXT}.includes('training')")
                assert "<b>careful" in page.run(TEXT)
                page.until("document.querySelectorAll('#run-rows tr').length === 2")
                page.until("document.querySelector('#run-rows tr td:nth-child(7)')?.textContent === '1'")
                assert page.violations() == []
                page.visit(page.run("document.querySelector('#run-rows a').href"))
                page.until("document.querySelectorAll('#submit-rows tr').length === 1")
                page.until("document.getElementById('messages')?.innerText.includes('<i>I saw</i>')")
                assert page.violations() == []
                (first,) = workspaces()

                # A worker is killed and comes back.
                page.visit(f"http://127.0.0.1:{web}/cluster")
                page.until("document.querySelector('#worker-rows td:nth-child(3)')?.textContent === 'active'")
                assert page.violations() == []
                assert page.problems == []
                os.kill(worker.pid, signal.SIGKILL)
                page.until("document.querySelector('#facts b')?.textContent.startsWith('1 of 1') === false")
                with process(log, *works):
                    page.until("document.querySelector('#facts b')?.textContent.startsWith('1 of ')")

                    # The coordinator restarts, and the page says so meanwhile.
                    coordinator.kill()
                    page.until("document.querySelector('#notices')?.innerText.includes('does not answer')")
                    coordinator = Coordinator(tmp_path / "s", *options)
                    page.until(
                        "document.querySelector('#notices')?.innerText.includes('does not answer') === false"
                    )
                    assert page.problems == []

                    # The view restarts, and the page reconnects by itself.
                    view.terminate()
                    view.wait(timeout=TIMEOUT_S)
                    page.until("document.getElementById('live')?.dataset.state === 'away'")
                    with process(log, *shows):
                        wait_until(answers)
                        page.until("document.getElementById('live')?.dataset.state === 'live'")
                        page.problems.clear()

                        # The first run is scored while the second one's agent is alive: its scores are hidden until
                        # that ends.
                        page.visit(f"http://127.0.0.1:{web}/")
                        (first / "go").touch()
                        wait_until(
                            lambda: (
                                sum(
                                    (each / "feedback/submit_000/summary.json").exists()
                                    for each in workspaces()
                                )
                                == 2
                            ),
                            lambda: sweep.text,
                        )
                        wait_until(
                            lambda: list((runs / "watched").glob("*/*/*/run.json")), lambda: sweep.text
                        )
                        page.until(
                            "[...document.querySelectorAll('#run-rows tr')].some((row) =>"
                            " row.innerText.includes('hidden'))"
                        )
                        for folder in workspaces():
                            (folder / "go").touch()
                        assert sweep.wait() == 0, sweep.err
                        page.until("document.querySelector('#facts b')?.textContent.startsWith('2 of 2')")
                        page.until(
                            "![...document.querySelectorAll('#run-rows tr')].some((row) =>"
                            " row.innerText.includes('hidden'))"
                        )
                        scores = page.run(
                            "[...document.querySelectorAll('#run-rows td:nth-child(9)')].map((cell) =>"
                            " cell.textContent)"
                        )
                        assert all(float(score.replace("−", "-")) for score in scores), scores
                        page.visit(page.run("document.querySelector('#run-rows a').href"))
                        page.visit(page.run("document.querySelector('#submit-rows a').href"))
                        assert "What changed in the code" in page.run(TEXT)
                        assert page.violations() == []
                        page.visit(page.run("document.querySelector('a[href*=\"/episode/\"]').href"))
                        assert page.run("document.querySelectorAll('figure svg[role=img]').length") >= 2
                        assert page.violations() == []
                        for width, dark in ((1280, True), (390, False)):
                            page.look(width=width, dark=dark, phone=width < 500)
                            page.visit(f"http://127.0.0.1:{web}/")
                            assert page.violations() == []
                            assert page.run("document.documentElement.scrollWidth <= innerWidth")
                        assert page.problems == []
            with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=TIMEOUT_S) as answer:
                output = answer.read().decode()
            for line in (
                'evopolicy_submits_total{verdict="ok"}',
                'evopolicy_episodes_total{split="heldout",verdict="ok"} 2.0',
                "evopolicy_submit_duration_seconds_bucket",
                "process_cpu_seconds_total",
                "evopolicy_up 1.0",
                "evopolicy_store_database_bytes",
            ):
                assert line in output, output
            with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/healthz", timeout=TIMEOUT_S) as answer:
                assert answer.read() == b"ok\n"
    finally:
        coordinator.stop()
