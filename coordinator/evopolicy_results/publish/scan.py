"""The transcript scan of published results: places in checkpoints and logs that a person should look at. Adds findings
that are never `failed`."""

from __future__ import annotations

from collections.abc import Iterator

from evopolicy_common.errors import ProtocolError
from evopolicy_results.publish import contents
from evopolicy_results.publish.findings import Checked, Files, PublishedRun
from evopolicy_results.publish.run_rules import recording_of
from evopolicy_results.scan.run import scan
from evopolicy_results.scan.signals import TITLES, Signal

_SHOWN = 8
"""Signals of a run that become findings."""


def scan_published(files: Files, checked: Checked) -> None:
    """Adds a finding for each signal, or one `ok` for a run without signals."""
    for run in checked.runs:
        name = run.opening.run
        try:
            found = _signals(files, run)
        except ProtocolError as error:
            checked.add("signals", "open", f"not searched: {error}", name)
            continue
        signals = [f"{TITLES[each.kind]}: {each.path}: {each.reason}: {each.quote}" for each in found]
        if len(signals) > _SHOWN:
            signals[_SHOWN:] = [f"{len(signals) - _SHOWN} more signals"]
        for text in signals:
            checked.add("signals", "open", text, name)
        if not signals:
            checked.add("signals", "ok", "no signal", name)


def _signals(files: Files, run: PublishedRun) -> tuple[Signal, ...]:
    log = f"{run.folder}/{contents.LOG}"
    lines = files.read(log, contents.MAX_DOCUMENT_BYTES).splitlines() if log in files.names else ()

    def trajectories(index: int) -> Iterator[list[object]]:
        for data in run.recordings(files, contents.group_name("train", index)):
            if data is not None:
                yield list(recording_of(data).actions)

    checkpoints = (
        (index, {file.path: file.data for file in bundle.files}) for index, bundle in run.bundles(files)
    )
    return scan(checkpoints, lines, trajectories)
