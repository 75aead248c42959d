"""Feedback use, submit by submit (paper, "feedback-utilization traces"): evidence read, change made, outcome seen.

Of each submit: what the agent read and wrote since the previous submit (`agent_log`, if the log shows it), and how
the policy changed. Sources and images stay on disk until a page needs them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.processes.left_files import left_files
from evopolicy_common.records import model_calls
from evopolicy_common.records.policies.trees import changes
from evopolicy_common.regular_files import read_regular
from evopolicy_results.behaviour.edits import Transition, classify
from evopolicy_results.code.sources import read_python_files, unified
from evopolicy_results.reading.agent_log import Evidence, LogReading, read_agent_log
from evopolicy_results.reading.records import PastRun, PastSubmit

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".gif", ".webp"})
MAX_IMAGE_BYTES = 4 << 20
MAX_IMAGES = 40
"""Maximum number of images on one run's page."""
MAX_DIFF_LINES = 1500
"""Maximum number of kept lines of one diff; the others are counted."""


class FileDiff(msgspec.Struct, frozen=True, kw_only=True):
    """One file's unified diff, three lines of context."""

    path: str
    lines: tuple[str, ...]
    """Without line ends; each begins with ` `, `+`, `-` or `@`."""
    cut: int
    """Number of lines left out at the end."""


class Trace(msgspec.Struct, frozen=True, kw_only=True):
    """A run's log and files by submit index, where there is anything of the submit."""

    run: PastRun
    transitions: Mapping[int, Transition]
    """Of the submits with a score, in their order."""
    evidence: Mapping[int, Evidence]
    work: Mapping[int, str]
    """In words, changes of the workspace outside `system/` before a submit, and calls of the model."""
    images: Mapping[int, Sequence[Path]]
    """Images that the agent made before a submit."""
    videos: Mapping[int, Path]
    """The first recorded episode of a submit's feedback."""
    unplaced: tuple[str, ...]
    """Messages of the agent that belong to no known submit."""


def trace(run: PastRun) -> Trace:
    """Reads the run's log and finds its images."""
    log = run.record.artifacts.logs_agent
    reading = read_agent_log(run.path / log, run.submits) if log else LogReading()
    indices = [submit.index for submit in run.submits]
    videos = {index: sorted(run.feedback(index).glob("episodes/ep_*/video.mp4")) for index in indices}
    calls = model_calls.before(run.path, [submit.started_at for submit in run.submits])
    outside = [f"workspace: {text}" if (text := changes(run.path, index)) else "" for index in indices]
    return Trace(
        run=run,
        transitions={each.index: each for each in classify(run.submits)},
        evidence=reading.by_submit,
        work={
            index: "; ".join(filter(None, texts))
            for index, *texts in zip(indices, outside, calls, strict=True)
        },
        images=_images(run, reading),
        videos={index: paths[0] for index, paths in videos.items() if paths},
        unplaced=reading.unplaced,
    )


def sources(run: PastRun, submit: PastSubmit) -> dict[str, str]:
    """Text of a checkpoint's source bundle by path, `policy.py` first; all its Python files if it has no bundle."""
    system = run.checkpoint(submit.index)
    try:
        if submit.source is not None:
            files = {path: read_regular(system / path) for path in submit.source.files}
        else:
            files = read_python_files(system)
    except OSError:
        return {}
    ordered = sorted(files, key=lambda path: (path != "policy.py", path))
    return {path: files[path].decode("utf-8", "replace") for path in ordered}


def diff(before: Mapping[str, str], after: Mapping[str, str]) -> list[FileDiff]:
    """Diffs of the files that differ, `policy.py` first."""
    out: list[FileDiff] = []
    for path in sorted({*before, *after}, key=lambda path: (path != "policy.py", path)):
        old, new = before.get(path, ""), after.get(path, "")
        if old == new:
            continue
        lines = unified(old.splitlines(), new.splitlines())
        kept = tuple(lines[:MAX_DIFF_LINES])
        out.append(FileDiff(path=path, lines=kept, cut=len(lines) - len(kept)))
    return out


def _images(run: PastRun, reading: LogReading) -> dict[int, list[Path]]:
    """Images by submit index: new in that checkpoint's `system/`, or in the final workspace and named in its part of
    the log. Workspace images without a name in the log are shown with the last submit."""
    named = {
        Path(name).name: index for index, evidence in reading.by_submit.items() for name in evidence.images
    }

    def candidates() -> Iterator[tuple[int, Path]]:
        for submit in run.submits:
            for path in _image_files(run.checkpoint(submit.index)):
                yield submit.index, path
        for path in _image_files(run.workspace, skip="feedback") if run.submits else ():
            yield named.get(path.name, run.submits[-1].index), path

    images: dict[int, list[Path]] = {}
    known: set[tuple[str, int]] = set()
    for index, path in candidates():
        key = (path.name, path.stat().st_size)
        if key not in known and len(known) < MAX_IMAGES:
            known.add(key)
            images.setdefault(index, []).append(path)
    return images


def _image_files(folder: Path, skip: str | None = None) -> Iterator[Path]:
    images = (
        path
        for path, size in left_files(folder, enter=lambda name: name != skip and not name.startswith("."))
        if path.suffix.lower() in IMAGE_SUFFIXES and size <= MAX_IMAGE_BYTES
    )
    return itertools.islice(images, MAX_IMAGES)
