"""The doctor's rows on this machine, and what they say where something is missing."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from evopolicy_common.processes import distribution, proc
from evopolicy_worker import doctor
from evopolicy_worker.environments.accelerations import acrobot_scalars, table
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.environments.interface.settings import BROWSER
from evopolicy_worker.sandbox import jail
from evopolicy_worker.slots.slot import why_not


def row_of(name: str) -> doctor.Check:
    """The check of that name; those after it are not made."""
    return next(each for each in doctor.examine() if each.name == name)


def test_every_part_of_the_sandbox_has_a_row_and_the_tier_follows() -> None:
    checks = tuple(doctor.examine())
    names = [check.name for check in checks]
    assert len(set(names)) == len(names)
    assert {"boot id", "bubblewrap", "namespace user", "Landlock", "cgroups"} < set(names)
    assert {"CPU pinning", "/dev/shm", "clock", "tier bwrap"} < set(names)
    assert doctor.best_tier(checks) == "bwrap"
    assert all(check.found for check in checks)
    assert all(check.advice for check in checks if check.verdict == "missing")


def test_what_is_missing_comes_with_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(jail, "landlock_version", lambda: 0)
    why_not.cache_clear()
    checks = {check.name: check for check in doctor.examine()}
    why_not.cache_clear()
    assert checks["bubblewrap"].advice == distribution.install("bubblewrap")
    assert "lsm=landlock" in checks["Landlock"].advice
    assert checks["tier bwrap"].verdict == checks["tier landlock"].verdict == "missing"
    assert doctor.best_tier(tuple(checks.values())) is None


def test_accelerations_that_are_off_are_named_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._accelerations().verdict == "ok"
    with monkeypatch.context() as patched:
        patched.setattr(table, "version", lambda name: "99.0" if name == "mujoco" else version(name))
        assert doctor._accelerations().found == "mujoco_state off (mujoco 99.0, proved: 3.10.0)"
        patched.setattr(acrobot_scalars, "holds", lambda: False)
        assert "acrobot_scalars off (not exact on this machine)" in doctor._accelerations().found
    monkeypatch.setenv("EVOPOLICY_ACCELERATIONS", "off")
    assert doctor._accelerations().found.startswith("all off")


def test_a_namespace_that_cannot_be_made_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_tried", lambda flags: 1)
    check = row_of("namespace user")
    assert check.verdict == "missing"
    assert distribution.permit_namespaces() in check.advice


def test_kernel_that_does_not_tell_its_boot_id_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert row_of("boot id").verdict == "ok"
    monkeypatch.setattr(proc, "_BOOT_ID", tmp_path / "none")
    check = row_of("boot id")
    assert check.verdict == "missing"
    assert "no hidden episodes" in check.found
    assert "mount /proc" in check.advice


@pytest.mark.system  # make test installs no browser
def test_the_browser_that_environments_use_has_a_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def row() -> doctor.Check:
        chromium.program.cache_clear()
        (found,) = [each for each in doctor.examine_machine() if each.name == "browser"]
        chromium.program.cache_clear()
        return found

    assert row().verdict == "ok"
    assert Path(row().found).is_file()
    monkeypatch.setenv(BROWSER, str(tmp_path / "gone"))
    assert (row().verdict, str(tmp_path / "gone") in row().advice) == ("note", True)
    monkeypatch.delenv(BROWSER)
    monkeypatch.setattr(chromium, "_PROGRAMS", ())
    monkeypatch.setenv("PATH", str(tmp_path))
    assert row().found == "no Chromium"
    assert distribution.install("chromium") in row().advice
