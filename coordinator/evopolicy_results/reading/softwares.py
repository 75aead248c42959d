"""Runs of both softwares in one report: splits are identified by content, and runs by software as well.

The published software records the hash of a case file's bytes, and we also that of the cases which a run used. A run of
ours on the same file therefore tells which cases a published run used.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from evopolicy_common.messages.environment import Split
from evopolicy_results.reading.published import HARNESS
from evopolicy_results.reading.records import Run

SPLITS: tuple[Split, ...] = ("train", "validation", "heldout")


def reconciled(runs: Sequence[Run]) -> tuple[Run, ...]:
    """The runs, where a published run has the splits of our runs on its files, and an entry of its own if one of ours
    has its name."""
    ours = [run for run in runs if not run.is_published]
    entries = {run.entry for run in ours}
    used: dict[tuple[Split, str], dict[str, set[int]]] = {}
    for run in ours:
        for split in SPLITS:
            versions = run.record.versions
            by_cases = used.setdefault((split, versions.file_hash(split)), {})
            by_cases.setdefault(versions.cases_hash(split), set()).add(_count(run, split))
    return tuple(_reconciled(run, used, entries) if run.is_published else run for run in runs)


def _reconciled(run: Run, used: dict[tuple[Split, str], dict[str, set[int]]], entries: set[str]) -> Run:
    record, versions = run.record, run.record.versions
    hashes: dict[Split, str] = {}
    for split in SPLITS:
        n, known = _count(run, split), used.get((split, versions.file_hash(split)), {})
        # Several runs of ours may have used different numbers of cases of the file.
        fitting = [cases for cases, counts in known.items() if not n or n in counts]
        if len(fitting) == 1:
            hashes[split] = fitting[0]
    agent = record.agent
    if run.entry in entries:
        agent = replace(agent, entry=f"{run.entry} ({HARNESS})")
    versions = replace(versions, cases_hashes={**versions.cases_hashes, **hashes})
    return replace(run, record=replace(record, agent=agent, versions=versions))


def _count(run: Run, split: Split) -> int:
    """Number of its cases of the split; 0 if unknown."""
    dimensions = run.record.experiment_dimensions
    return {
        "train": dimensions.n_train,
        "validation": dimensions.n_validation,
        "heldout": dimensions.n_heldout,
    }[split]
