"""An episode or submit over which gateways die is put aside with an error, and the run goes on.

Attacks, each with its defence:
- crashes the gateway repeatedly with one episode's files: an episode that crashed two gateways is set aside
  with an error.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import gateway_double
import pytest
from gateway_double import Double, gateway_on, opened, packed_episode, prepared, served

from evopolicy_common.records.episodes import rendered
from evopolicy_common.records.open_run import Died, SubmitRefused
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.submits import formatting

IDS = [1, 2, 3]
WHOLE = {"trajectory.jsonl", "stdout.txt", "stderr.txt"}


def files_of(folder: Path, submit: str = "submit_000") -> dict[str, set[str]]:
    episodes = folder / submit / "episodes"
    return {path.name: {file.name for file in path.iterdir()} for path in sorted(episodes.iterdir())}


def rows(folder: Path, episode: str, submit: str = "submit_000") -> list[dict[str, Any]]:
    text = (folder / submit / "episodes" / episode / "error.txt").read_text()
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.parametrize("kind", ["junk", "too long"])
async def test_an_episode_whose_trajectory_cannot_be_written_is_put_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    real = packed_episode
    junk = {"junk": b"junk", "too long": packed_episode(3, n_steps=500)}[kind]
    monkeypatch.setattr(gateway_double, "packed_episode", lambda case: junk if case == 3 else real(case))
    monkeypatch.setattr(rendered, "MAX_ROWS_BYTES", 5000)

    async with served(tmp_path) as s:
        answer = await s.submit(IDS)
        assert (answer.status_code, answer.json()["status"]) == (200, "ok")
        assert len(answer.json()["summary"]["returns"]) == 3
        assert files_of(s.folder.feedback) == {
            "ep_000": WHOLE,
            "ep_001": WHOLE,
            "ep_002": {"error.txt", "stdout.txt", "stderr.txt"},
        }
        (line,) = rows(s.folder.feedback, "ep_002")
        assert line["category"] == "feedback_error"
        assert "cannot be written; the episode's return counts" in line["message"]


async def test_an_episode_whose_recording_is_gone_is_put_aside(tmp_path: Path) -> None:
    double = Double(opened())
    double.lost = {2}
    async with served(tmp_path, double) as s:
        assert (await s.submit(IDS)).json()["status"] == "ok"
        assert [line["message"] for line in rows(s.folder.feedback, "ep_001")] == [
            "this episode's trajectory or video is not stored any more; the episode's return counts"
        ]
        assert files_of(s.folder.feedback)["ep_000"] == WHOLE


KILLED = """
import asyncio, os, signal, sys
from pathlib import Path
from evopolicy_gateway.submits import feedback as submits
from evopolicy_gateway.run.gateway import Gateway
from evopolicy_common.records.episodes import rendered
from evopolicy_gateway.run_folder.layout import RunFolder

real = submits.episode_files

def episode_files(episode, *args, **options):
    if episode.index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(episode, *args, **options)

submits.episode_files = episode_files

async def main():
    gateway = Gateway(RunFolder(Path(sys.argv[1])), on_ready=lambda urls, pipeline: None, on_change=on_change)
    await gateway.run()

def on_change(pipeline):
    if pipeline.machine.tickets and pipeline.machine.tickets[0].done:
        os._exit(0)

asyncio.run(main())
"""


async def test_an_episode_that_kills_two_gateways_is_set_aside(tmp_path: Path) -> None:
    async def child(folder: Path) -> int:
        process = await asyncio.create_subprocess_exec(sys.executable, "-c", KILLED, str(folder))
        return await asyncio.wait_for(process.wait(), 120)

    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double) as s:
            double.go.clear()
            await s.submit([1, 2, 3, 4], wait=False)
        double.go.set()
        ends = [await child(folder.root) for _ in range(3)]
        assert ends == [-9, -9, 0]
        journal = Journal(folder.journal)
        died = [entry.episodes for entry in journal.entries.values() if isinstance(entry, Died)]
        journal.close()
        assert died[0] in ((2,), (3, 2), (2, 3))
        assert died[1:] == [(2,)]
        found_files = files_of(folder.feedback)
        assert found_files["ep_002"] == {"error.txt", "stdout.txt", "stderr.txt"}
        assert {frozenset(files) for name, files in found_files.items() if name != "ep_002"} == {
            frozenset(WHOLE)
        }
        assert "ended 2 times" in rows(folder.feedback, "ep_002")[0]["message"]
        async with gateway_on(folder, double) as s:
            assert (await s.http.get(f"{s.urls.submit}/submit_000")).json()["status"] == "ok"


async def ended_by_a_submit(folder: RunFolder, double: Double) -> None:
    async with gateway_on(folder, double) as s:
        await s.submit(IDS, wait=False)
        await asyncio.wait([s.task])


async def test_a_submit_ending_two_gateways_is_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = formatting.summary_bytes

    def summary_bytes(env: str, index: int, *args: Any, **options: Any) -> bytes:
        if index == 0:
            raise KeyError("nobody has thought of this")
        return real(env, index, *args, **options)

    monkeypatch.setattr(formatting, "summary_bytes", summary_bytes)

    async with prepared(tmp_path) as (folder, double):
        with pytest.raises(KeyError):
            await ended_by_a_submit(folder, double)
        async with gateway_on(folder, double) as s:
            await s.pipeline.idle()
            answer = await s.http.get(f"{s.urls.submit}/submit_000")
            assert (answer.status_code, answer.json()["status"]) == (500, "gateway_failed")
            assert "charged" in answer.json()["error"]["message"]
            again = await s.submit(IDS)
            assert (again.json()["submit_id"], again.json()["status"]) == (1, "ok")
        async with gateway_on(folder, double) as s:
            assert (await s.http.get(f"{s.urls.submit}/submit_000")).status_code == 500
            assert (await s.http.get(f"{s.urls.submit}/submit_001")).status_code == 200
        journal = Journal(folder.journal)
        assert sum(isinstance(entry, SubmitRefused) for entry in journal.entries.values()) == 1
        journal.close()
