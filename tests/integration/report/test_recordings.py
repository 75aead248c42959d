"""Recordings of held-out episodes: one sweep on a real cluster plays the same policy unrecorded, recorded, and with
videos in its feedback; a real headless Chromium shows its report."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import pytest
from browser import Page
from typer.testing import CliRunner

from evopolicy_common.records.run_difference import differences
from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_results.behaviour.trace import trace
from evopolicy_results.cli.report import app
from evopolicy_results.reading.reader import load_runs

pytestmark = pytest.mark.system

TIMEOUT_S = 600.0
ENVIRONMENTS = ("toy/line", "gymnasium/FetchPickAndPlace-v4")
"""The second one's episode is another when it is drawn without care."""
SUITE = Path(__file__).with_name("recordings.toml").read_text()
FAKES = Path(__file__).parents[2] / "support" / "fake_clis"
POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space
        self.t = 0

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        self.t += 1
        if self.space["type"] == "Discrete":
            return self.space.get("start", 0) + self.t % self.space["n"]
        return [(-1.0) ** (self.t // 5) * 0.9] * self.space["shape"][0]
"""
VIDEOS = """Promise.all([...document.querySelectorAll('video')].map((video) => new Promise((done) => {
  const report = () => done([video.readyState, video.videoWidth, video.videoHeight, video.duration, video.error && video.error.message]);
  if (video.readyState >= 2 || video.error) { report(); return; }
  video.addEventListener('loadeddata', report); video.addEventListener('error', report);
  video.preload = 'auto'; video.load();
})))"""  # noqa: E501


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("r")
    (folder / "t.toml").write_text(SUITE.replace("{python}", sys.executable).replace("{fakes}", str(FAKES)))
    (folder / "policies").mkdir()
    (folder / "policies/policy.py").write_text(POLICY)
    command = [sys.executable, "-m", "evopolicy_gateway.cli", "suite", "t.toml", "--local", "--parallel", "2"]
    running = subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, "XDG_STATE_HOME": str(folder / "xdg")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = running.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGTERM)
        raise
    assert running.returncode == 0, output
    return folder / "runs/t"


def run_dir(runs: Path, entry: str, env: str) -> Path:
    return runs / entry / env.replace("/", "_") / "t-0"


def record_in(folder: Path) -> RunRecord:
    return decode_run_record((folder / "run.json").read_bytes())


def n_frames(path: Path) -> int:
    with av.open(io.BytesIO(path.read_bytes())) as container:
        return sum(1 for _ in container.decode(video=0))


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_recordings_are_in_the_run_directory_and_run_json_names_them(runs: Path, env: str) -> None:
    folder = run_dir(runs, "filmed", env)
    record = record_in(folder)
    replays = record.replays
    assert [replay.path for replay in replays] == [
        "replays/heldout_000/video.mp4",
        "replays/heldout_001/video.mp4",
    ]
    assert [replay.episode for replay in replays] == [0, 1]
    assert {replay.submit_index for replay in replays} == {record.outcome.best_submit_index}
    assert tuple(replay.episode_return for replay in replays) == record.outcome.heldout_returns
    for replay in replays:
        assert n_frames(folder / replay.path) == replay.length


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_recording_changes_no_score_and_no_byte_of_the_run(runs: Path, env: str) -> None:
    plain, filmed = run_dir(runs, "plain", env), run_dir(runs, "filmed", env)
    assert record_in(plain).outcome.heldout_returns == record_in(filmed).outcome.heldout_returns
    assert not (plain / "replays").exists()
    found = differences(plain, filmed)
    # Names of the two entries, and random actions, which are every run's own.
    own = ("model", "agent.entry", "replays", "outcome.random_reference")
    left = [
        line
        for line in found
        if not line.startswith("replays/") and not any(f"run.json: {name}" in line for name in own)
    ]
    assert left == []


def test_feedback_has_videos_of_the_first_episode_or_of_all(runs: Path) -> None:
    def videos(entry: str) -> list[bool]:
        episodes = (run_dir(runs, entry, "toy/line") / "workspace/feedback/submit_000/episodes").iterdir()
        return [(episode / "video.mp4").exists() for episode in sorted(episodes)]

    assert videos("plain") == videos("filmed") == [False, False, False]
    assert videos("shown") == [True, False, False]
    assert videos("shown all") == [True, True, True]


def test_held_out_recordings_follow_the_feedbacks_option_unless_they_have_their_own(runs: Path) -> None:
    shown = record_in(run_dir(runs, "shown", "toy/line"))
    assert [replay.episode for replay in shown.replays] == [0]
    assert record_in(run_dir(runs, "shown all", "toy/line")).replays == ()


def test_recorded_videos_play_in_a_browser_with_the_agents_side_by_side(runs: Path, tmp_path: Path) -> None:
    arguments = [str(runs), "--out", str(tmp_path / "report")]
    refused = CliRunner().invoke(app, arguments)
    assert "videos in feedback on toy/line" in refused.output
    invoked = CliRunner().invoke(app, [*arguments, "--allow-mixed"])
    assert invoked.exit_code == 0, invoked.output
    pages = sorted((tmp_path / "report/replays").glob("*.html"))
    assert [page.stem for page in pages] == ["gymnasium-FetchPickAndPlace-v4", "toy-line"]
    with Page() as page:
        found: dict[str, list[Any]] = {}
        for path in [*pages, *sorted((tmp_path / "report/traces").glob("toy-line-shown-*.html"))]:
            page.open(path)
            found[path.stem] = page.run(VIDEOS)
            if path.parent.name == "replays":
                assert page.run("document.querySelectorAll('.card').length") == len(found[path.stem])
        # Two episodes of "filmed"; on the toy one of "shown" besides. Two feedback videos beside their submits.
        assert sorted(len(videos) for videos in found.values()) == [1, 1, 2, 3]
        for stem, videos in found.items():
            for ready, width, height, duration, error in videos:
                assert error is None, (stem, error)
                assert ready >= 2, stem
                assert width > 0 < height, stem
                assert duration > 0, stem
        assert page.problems == []


def test_report_says_which_recordings_there_are(runs: Path, tmp_path: Path) -> None:
    arguments = [str(runs), "--out", str(tmp_path / "report"), "--allow-mixed"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    text = (tmp_path / "report/index.html").read_text()
    assert 'href="replays/toy-line.html"' in text
    assert json.loads((tmp_path / "report/report.json").read_text())["left_out"] == []


@pytest.mark.parametrize("entry", ["codex", "claude"])
def test_a_harnesss_log_tells_what_was_read_and_said_before_each_submit(runs: Path, entry: str) -> None:
    loaded = load_runs([run_dir(runs, entry, "toy/line")])
    (run,) = loaded.runs
    found = trace(run)
    first, second, third = (found.evidence[index] for index in range(3))
    assert (first.read, first.messages) == ((), ())
    before = run.submits
    assert [one.index for one in before] == [0, 1, 2]
    for evidence, submit, plan in (
        (second, before[0], "add a term"),
        (third, before[1], "change a constant"),
    ):
        name = f"submit_{submit.index:03d}"
        assert evidence.read == (f"feedback/{name}/summary.json",)
        quote = f"{name} came to a mean return of {submit.mean_return:.4g}. I {plan} next."
        assert evidence.attribution == quote
        assert evidence.messages == ("submitted", quote)
    assert found.unplaced == ("submitted",)
    assert [each.edit for each in found.transitions.values()] == ["first", "synthesis", "parametric"]


def test_trace_page_quotes_the_agent_beside_the_files_that_it_read(runs: Path, tmp_path: Path) -> None:
    arguments = [str(run_dir(runs, "codex", "toy/line")), "--out", str(tmp_path / "report")]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    (path,) = (tmp_path / "report/traces").glob("*.html")
    with Page() as page:
        page.open(path)
        row = "document.getElementById('submit-2').cells"
        assert (
            page.run(f"{row}[4].querySelector('.read').textContent.trim()")
            == "feedback/submit_001/summary.json"
        )
        assert page.run(f"{row}[4].querySelector('blockquote').textContent").endswith(
            "I change a constant next."
        )
        assert page.problems == []
