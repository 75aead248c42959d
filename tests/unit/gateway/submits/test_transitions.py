"""Steps whose action was repaired are counted from what the gateway wrote, whatever an agent has put beside it."""

from __future__ import annotations

import os
from pathlib import Path

from evopolicy_common.records.json_text import rows_text
from evopolicy_gateway.submits.feedback import MAX_READ_BYTES, count_transitions

TEXT = '"action_invalid":true'
"""A text that a policy may return as its action, or an environment may show."""


def write(feedback: Path, submit: int, episode: int, *infos: dict[str, object]) -> Path:
    folder = feedback / f"submit_{submit:03d}" / "episodes" / f"ep_{episode:03d}"
    folder.mkdir(parents=True)
    n = len(infos)
    rows = rows_text(0, [TEXT] * n, [TEXT] * n, [0.0] * n, [False] * n, [False] * n, infos)
    (folder / "trajectory.jsonl").write_bytes(rows)
    return folder


def test_steps_and_repaired_ones_are_counted_over_all_submits(tmp_path: Path) -> None:
    write(tmp_path, 0, 0, {"steps": 1}, {"steps": 2, "action_invalid": True})
    write(tmp_path, 1, 1, {"action_invalid": True}, {"said": TEXT}, {"action_invalid": False})
    assert count_transitions(tmp_path) == {"steps": 5, "action_invalid": 2}


def test_pipes_links_and_other_files_are_passed_over(tmp_path: Path) -> None:
    feedback = tmp_path / "feedback"
    folder = write(feedback, 0, 0, {"action_invalid": True})
    os.mkfifo(folder.parent / "trajectory.jsonl")
    piped = feedback / "submit_001" / "episodes" / "ep_001"
    piped.mkdir(parents=True)
    os.mkfifo(piped / "trajectory.jsonl")
    linked = feedback / "submit_002" / "episodes" / "ep_002"
    linked.mkdir(parents=True)
    (linked / "trajectory.jsonl").symlink_to("/dev/zero")
    (folder / "notes.jsonl").write_text('{"action_invalid":true}\n')
    assert count_transitions(feedback) == {"steps": 1, "action_invalid": 1}


def test_feedback_that_is_absent_a_link_or_too_large_is_not_counted(tmp_path: Path) -> None:
    assert count_transitions(tmp_path / "none") is None
    folder = write(tmp_path / "feedback", 0, 0, {})
    (tmp_path / "link").symlink_to(tmp_path / "feedback")
    assert count_transitions(tmp_path / "link") is None
    os.truncate(folder / "trajectory.jsonl", MAX_READ_BYTES + 1)  # a hole, which takes no room
    assert count_transitions(tmp_path / "feedback") is None
