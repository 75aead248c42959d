"""An operator's acts from the page, in a real browser on a real cluster: each is confirmed, has its effect, and is
written down."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest
from browser import Page
from commands import AGENT, command, process
from coordinator_harness import Coordinator
from waiting import TIMEOUT_S, wait_until

from evopolicy_coordinator.web.access import kept_tokens

pytestmark = pytest.mark.system

SUITE = """
name = "acted"
environments = ["toy/line"]
[defaults]
repeats = 2
budget = 6
validation = 1
heldout = 1
[parallel]
machine = 1
[[agents]]
name = "patient"
agent = "command:{python} {agent}"
[agents.jail]
read = ["{agent}"]
"""
PATIENT = """
def wait_for(name):
    while not os.path.exists(name):
        time.sleep(0.05)

submit("0")
for number in range(1, 6):
    wait_for(f"go-{number}")
    if number == 2:  # a slow one: its worker is killed meanwhile
        with open("system/policy.py", "a") as file:
            file.write("\\nimport time\\nact_at_once = Policy.act\\ndef act(self, obs):\\n    time.sleep(0.4)\\n")
            file.write("    return act_at_once(self, obs)\\nPolicy.act = act\\n")
    if number == 3:
        source = open("system/policy.py").read()
        open("system/policy.py", "w").write(source.replace("time.sleep(0.4)", "pass"))
    submit(str(number))
wait_for("the end")
"""
TEXT = "(document.body?.innerText ?? '')"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_runs_workers_and_sweeps_are_acted_on_from_the_page(tmp_path: Path) -> None:
    program = tmp_path / "agent.py"
    program.write_text(AGENT + PATIENT)
    (tmp_path / "suite.toml").write_text(SUITE.format(python=sys.executable, agent=program))
    other = tmp_path / "other" / "numpy-99.0.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 99.0\n")
    runs, log, acts = tmp_path / "runs", tmp_path / "log", tmp_path / "acts.jsonl"
    runs.mkdir()
    coordinator = Coordinator(tmp_path / "s", "--hidden-isolation", "off")
    joins, operator = (coordinator.ready["credentials"][role] for role in ("worker", "operator"))
    works = ("evopolicy_worker.cli", "--env", "toy", "--slots", "1", "--grace", "0", "--credentials", joins)
    tokens, address = kept_tokens(tmp_path / "tokens"), tmp_path / "address"
    shows = ("evopolicy_gateway.cli", "web", str(runs), "--credentials", operator, "--http", "127.0.0.1:0")
    shows += ("--token-file", str(tmp_path / "tokens"), "--url-file", str(address))
    shows += ("--act", "--action-log", str(acts))
    plays = ("suite", str(tmp_path / "suite.toml"), "--runs", str(runs / "acted"), "--credentials", operator)

    def workspaces() -> list[Path]:
        return sorted((runs / "acted").glob("*/*/*/workspace"))

    def done(folder: Path) -> int:
        return len(list(folder.glob("feedback/submit_*/summary.json")))

    try:
        with (
            process(log, *works, "--name", "w-first") as first,
            process(log, *shows),
            Page(timeout_s=TIMEOUT_S) as page,
            Page(timeout_s=TIMEOUT_S) as reader,
        ):
            wait_until(address.exists, log.read_text)
            base = address.read_text().partition("/login")[0]

            def act(where: str, link: str, reason: str = "") -> None:
                """Follows a link to an act, and confirms it."""
                page.visit(f"{base}{where}")
                anchor = f"[...document.querySelectorAll('a[href^=\"/act/\"]')].find((a) => {link})"
                page.until(f"{anchor} !== undefined")
                page.visit(page.run(f"{anchor}.href"))
                assert "What happens:" in page.run(TEXT)
                assert page.violations() == []
                if reason:
                    page.run(f"document.querySelector('input[name=reason]').value = {json.dumps(reason)}")
                page.run("document.querySelector('button.danger').click()")
                page.until("!location.pathname.startsWith('/act/')")

            for one, token in ((page, tokens.act), (reader, tokens.read)):
                one.visit(f"{base}/login#token={token}")
                one.until("document.getElementById('live')?.textContent === 'live'")
            with command(tmp_path, *plays) as sweep:
                (folder,) = wait_until(workspaces, lambda: sweep.text)
                wait_until(lambda: done(folder) == 1, lambda: sweep.text)

                # A second operator sees the same and has nothing to act with.
                reader.visit(f"{base}/")
                reader.until(f"{TEXT}.includes('acted')")
                assert reader.run("document.querySelectorAll('a[href^=\"/act/\"]').length") == 0

                act("/", "a.href.endsWith('/pause')")
                assert (runs / "acted" / "paused").exists()
                reader.until("document.querySelector('.pill')?.textContent === 'paused'")

                # A paused worker gets no work: the submit waits for it, and the page says so.
                act("/cluster", "a.href.endsWith('/worker/w-first/pause')")
                page.until(f"{TEXT}.includes('paused')")
                (folder / "go-1").touch()
                page.until("document.getElementById('queue')?.innerText.includes('those that do are paused')")
                assert done(folder) == 1
                act("/cluster", "a.href.endsWith('/worker/w-first/resume')")
                wait_until(lambda: done(folder) == 2, lambda: sweep.text)

                # Its worker is killed in the midst of an episode, and one of other versions comes.
                busy = "document.querySelector('#worker-rows td:nth-child(4)')?.textContent"
                page.until(f"{busy} === '0/1'")
                (folder / "go-2").touch()
                page.until(f"{busy} === '1/1'")
                os.kill(first.pid, signal.SIGKILL)
                with process(log, *works, "--name", "w-other", PYTHONPATH=str(other.parent)) as second:
                    opened = "document.querySelector('#open-rows a')?.getAttribute('href')"
                    page.until(f"{opened} !== undefined")
                    run_page = page.run(opened)
                    act(run_page, "a.href.includes('/repin?class=')", reason="the first machine has died")
                    page.visit(f"{base}{run_page}")
                    lost = "Worker w-first was lost with 1 job of this run"
                    page.until(f"document.getElementById('events')?.innerText.includes({lost!r})")
                    (folder / "go-3").touch()
                    wait_until(lambda: done(folder) == 4, lambda: sweep.text)

                    act("/", "a.href.endsWith('/resume')")
                    assert not (runs / "acted" / "paused").exists()
                    act(run_page, "a.href.endsWith('/cancel')")
                    wait_until(lambda: len(workspaces()) == 2, lambda: sweep.text)
                    (written,) = wait_until(lambda: list(folder.parent.glob("run.json")))
                    record = json.loads(written.read_text())
                    assert record["outcome"]["status"] == "cancelled"
                    assert "the first machine has died" in json.dumps(record)
                    cells = "[...document.querySelectorAll('#run-rows td')]"
                    reader.until(f"{cells}.some((cell) => cell.textContent === 'cancelled')")

                    # A drained worker ends by itself.
                    act("/cluster", "a.href.endsWith('/worker/w-other/drain')")
                    assert second.wait(timeout=TIMEOUT_S) == 0
            page.visit(f"{base}/log")
            assert page.violations() == []
            assert "the first machine has died" in page.run(TEXT)
            assert page.problems == []
            assert reader.problems == []
    finally:
        coordinator.stop()
    entries = [json.loads(line) for line in acts.read_text().splitlines()]
    names = [
        "sweep pause",
        "worker pause",
        "worker resume",
        "run repin",
        "sweep resume",
        "run cancel",
        "worker drain",
    ]
    told = [(name, outcome) for name in names for outcome in ("asked", "done")]
    assert [(one["act"], one["outcome"]) for one in entries] == told
    assert [one["name"] for one in entries[::2]][:3] == ["acted", "w-first", "w-first"]
    assert entries[6]["reason"] == entries[7]["reason"] == "the first machine has died"
    assert {one["by"] for one in entries} == {"browser at 127.0.0.1"}
    text = acts.read_text()
    assert tokens.act not in text
    assert tokens.read not in text
