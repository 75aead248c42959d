"""The advice at the end of `evopolicy doctor`."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from evopolicy_worker import doctor
from evopolicy_worker.doctor import Check


@pytest.mark.parametrize(
    ("verdict", "told"), [("ok", "evopolicy demo"), ("missing", "--tier landlock --jail none")]
)
def test_the_demo_is_advised_only_where_its_jail_starts(
    monkeypatch: pytest.MonkeyPatch, verdict: str, told: str
) -> None:
    def check(name: str, verdict: str) -> Check:
        return Check(name=name, verdict=verdict, found="x", without="x", advice="x")  # type: ignore[arg-type]

    monkeypatch.setattr(doctor, "examine_machine", list)
    found = (check("tier bwrap", verdict), check("tier landlock", "ok"))
    monkeypatch.setattr(doctor, "examine", lambda: found)
    done = CliRunner().invoke(doctor.app, [])
    assert done.exit_code == 0
    assert told in done.stdout
    assert ("evopolicy demo" in done.stdout) == (verdict == "ok")
