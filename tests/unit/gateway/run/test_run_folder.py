"""The small files of a run's folder: what a disk has damaged is told with its path and the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.open_run import OpenedRun
from evopolicy_gateway.run_folder.layout import RunFolder, save, saved


def test_a_file_that_a_disk_has_damaged_is_reported(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.state.mkdir()
    save(folder.opened_run, OpenedRun(run="r-1"))
    assert saved(folder.opened_run, OpenedRun).run == "r-1"
    for damaged in (b"", b"{", b"\xff", b"[" * 100_000, b'{"run": 1}'):
        folder.opened_run.write_bytes(damaged)
        with pytest.raises(ConfigError, match=f"{folder.opened_run} is damaged.*--overwrite"):
            saved(folder.opened_run, OpenedRun)
