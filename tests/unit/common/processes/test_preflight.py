"""The machine's faults are told with path and remedy; anything else stays a bug with its traceback."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.errors import ConfigError, DamagedStoreError
from evopolicy_common.processes.preflight import check_text, check_writable, explained


def refuse(monkeypatch: pytest.MonkeyPatch, fault: int) -> None:
    """Makes the disk refuse temporary files."""

    def refuses(**_: Any) -> None:
        raise OSError(fault, os.strerror(fault))

    monkeypatch.setattr(tempfile, "TemporaryFile", refuses)


def test_a_full_disk_is_reported_unless_who_asks_waits_for_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, errno.ENOSPC)
    with pytest.raises(ConfigError, match=f"{tmp_path / 'new'}.*make room.*--state"):
        check_writable(tmp_path / "new", "--state")
    check_writable(tmp_path / "new", "--state", may_be_full=True)


@pytest.mark.parametrize(
    ("fault", "code"),
    [(errno.ENOSPC, 1), (errno.EROFS, 1), (errno.EDQUOT, 1), (errno.EACCES, 2), (errno.ENOTDIR, 2)],
)
def test_only_passing_causes_restart_a_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: int, code: int
) -> None:
    refuse(monkeypatch, fault)
    with pytest.raises(SystemExit) as ended, fail_on_our_errors():
        check_writable(tmp_path, "--state")
    assert ended.value.code == code


def test_an_argument_that_is_not_utf8_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["evopolicy", "status", "--connect", "tcp/odd-\udcff:1"])
    with pytest.raises(SystemExit) as ended, fail_on_our_errors():
        "odd-\udcff".encode()
    assert ended.value.code == 2
    assert "'odd-\N{REPLACEMENT CHARACTER}' is not UTF-8" in capsys.readouterr().err
    with pytest.raises(UnicodeEncodeError), fail_on_our_errors():
        "another-\udcff".encode()


def test_what_is_checked_leaves_nothing_behind(tmp_path: Path) -> None:
    check_writable(tmp_path / "a/b/c", "--out")
    assert list(tmp_path.iterdir()) == []


def test_a_path_that_is_not_utf8_is_reported_printably(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"odd-\\xff: this path is not UTF-8; choose another with --state"):
        check_text(Path(os.fsdecode(b"/odd-\xff")), "--state")


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (OSError(errno.EROFS, os.strerror(errno.EROFS), "/srv/runs"), 1, "/srv/runs: Read-only file system"),
        (DamagedStoreError("this row cannot be read"), 2, "this row cannot be read"),
    ],
)
def test_an_error_that_is_no_bug_ends_a_command_in_a_line(
    capsys: pytest.CaptureFixture[str], error: Exception, code: int, told: str
) -> None:
    with pytest.raises(SystemExit) as ended, fail_on_our_errors():
        raise error
    assert ended.value.code == code
    assert told in capsys.readouterr().err


def test_an_error_that_may_be_a_bug_keeps_its_traceback() -> None:
    missing = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "/x")
    assert explained(missing) is None
    with pytest.raises(FileNotFoundError), fail_on_our_errors():
        raise missing
