"""The feedback tree on disk."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from evopolicy_common.records.blobs import sync_filesystem
from evopolicy_gateway.submits import feedback
from evopolicy_gateway.submits.feedback import SubmitTree


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def tree(tmp_path: Path) -> SubmitTree:
    """Of submit_000, begun in `tmp_path`."""
    made = SubmitTree(tmp_path, "submit_000")
    made.begin()
    return made


def test_episodes_stream_into_the_partial_folder_and_a_rename_commits_them(
    tree: SubmitTree, tmp_path: Path
) -> None:
    tree.put_episode("ep_001", {"trajectory.jsonl": b"1\n"})
    assert names(tmp_path) == ["submit_000.partial"]
    assert names(tmp_path / "submit_000.partial" / "episodes") == ["ep_001"]
    tree.commit(b"{}\n", None)
    assert names(tmp_path) == ["submit_000"]
    assert names(tmp_path / "submit_000") == ["episodes", "summary.json"]


def test_the_summary_is_written_last(tree: SubmitTree, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    real = os.open

    def opened(path: object, flags: int, *args: int, **kwargs: int) -> int:
        if flags & os.O_CREAT:
            written.append(Path(str(path)).name)
        return real(path, flags, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "open", opened)
    tree.put_episode("ep_000", {"trajectory.jsonl": b"", "stdout.txt": b""})
    tree.commit(b"{}\n", b"why\n")
    assert written == ["trajectory.jsonl", "stdout.txt", "errors.txt", "summary.json"]


def test_feedback_is_durable_before_it_has_its_name(
    tree: SubmitTree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []

    def flush(folder: Path) -> None:
        sync_filesystem(folder)
        seen.append(names(folder) + names(folder / "episodes") + names(tmp_path))

    monkeypatch.setattr(feedback, "sync_filesystem", flush)
    tree.put_episode("ep_000", {"trajectory.jsonl": b""})
    tree.commit(b"{}\n", None)
    assert seen == [["episodes", "summary.json", "ep_000", "submit_000.partial"]]


def test_beginning_again_forgets_what_was_written(tree: SubmitTree, tmp_path: Path) -> None:
    tree.put_episode("ep_000", {"a": b"old"})
    tree.begin()
    tree.put_episode("ep_000", {"a": b"new"})
    tree.put_episode("ep_000", {"a": b"newer"})
    tree.commit(b"{}\n", None)
    assert (tmp_path / "submit_000" / "episodes" / "ep_000" / "a").read_bytes() == b"newer"


def test_a_folder_committed_without_a_journal_entry_is_replaced(tmp_path: Path) -> None:
    for text in (b"1", b"2"):
        tree = SubmitTree(tmp_path, "submit_000")
        tree.begin()
        tree.commit(text, None)
    assert tree.final.joinpath("summary.json").read_bytes() == b"2"


def test_a_dropped_episode_is_gone(tree: SubmitTree) -> None:
    tree.put_episode("ep_000", {"a": b""})
    tree.drop_episode("ep_000")
    tree.drop_episode("ep_001")
    tree.commit(b"{}", b"e")
    assert names(tree.final / "episodes") == []


def test_links_in_the_way_are_removed_and_not_followed(tmp_path: Path) -> None:
    root, outside = tmp_path / "feedback", tmp_path / "outside"
    root.mkdir()
    outside.mkdir()
    (outside / "precious").write_text("x")
    (root / "submit_000.partial").symlink_to(outside)
    (root / "submit_000").symlink_to(outside)
    tree = SubmitTree(root, "submit_000")
    tree.begin()
    tree.commit(b"{}", None)
    assert names(outside) == ["precious"]
    assert not tree.final.is_symlink()
