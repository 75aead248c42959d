"""Files of single packages, for jails that show those alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError, RefusedError
from evopolicy_common.processes import packages
from evopolicy_common.processes.packages import (
    check_alone,
    files_of,
    modules_of,
    packages_in,
    policy_versions,
)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages of the test's own, beside the real ones."""
    monkeypatch.syspath_prepend(str(tmp_path))
    packages._owners.cache_clear()
    return tmp_path


def install(site: Path, name: str, *files: str, requires: tuple[str, ...] = ()) -> None:
    info = site / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    lines = [f"Name: {name}", "Version: 1.0", *(f"Requires-Dist: {each}" for each in requires)]
    (info / "METADATA").write_text("\n".join(["Metadata-Version: 2.1", *lines, ""]))
    (info / "RECORD").write_text("".join(f"{each},,\n" for each in (*files, f"{info.name}/METADATA")))
    for file in files:
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        (site / file).touch()


def test_scipy_is_shown_with_its_libraries_and_numpy_and_nothing_else() -> None:
    found = files_of(["scipy"])
    assert {name.partition(".")[0] for name in found} == {"numpy", "scipy"}
    assert all(Path(path).exists() for path in found.values())
    check_alone(["scipy"])
    versions = policy_versions(["scipy"])
    assert sorted(versions) == ["policy", "policy:scipy"]
    assert versions["policy"] == "scipy"


def test_a_fingerprint_tells_the_packages_that_a_runs_policies_imported() -> None:
    assert packages_in(policy_versions(["scipy"])) == ("scipy",)
    assert packages_in({"numpy": "2"}) == ()
    assert policy_versions([]) == {}


def test_a_distribution_is_imported_by_the_names_of_its_modules(site: Path) -> None:
    install(site, "own-tool", "own_module.py", "owntool/__init__.py", "own_tool.libs/libown.so")
    assert modules_of(["scipy", "own-tool"]) == ["scipy", "owntool", "own_module"]


def test_requirements_come_along_and_those_of_extras_or_not_installed_do_not(site: Path) -> None:
    requires = ("own-part>=1", "absent", "rich; extra == 'x'")
    install(site, "own-tool", "own_tool/__init__.py", requires=requires)
    install(site, "own-part", "own_part.py")
    assert sorted(files_of(["own-tool"])) == ["own_part.py", "own_tool"]
    assert sorted(files_of(["own-tool"], metadata_too=True))[:2] == ["own_part-1.0.dist-info", "own_part.py"]


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("no-such-package", "is not installed"),
        ("gymnasium", "is a simulator"),
        ("own-planner", "requires mujoco"),
        ("own-environments", "is a simulator"),
        ("evopolicy", "is a simulator"),
        ("scipy; touch /tmp/x", "is no name of a package; leave it out$"),
        ("../../scipy", "is no name of a package; leave it out$"),
        ("--index-url=x", "is no name of a package; leave it out$"),
    ],
)
def test_a_package_that_no_policy_may_see_is_named(site: Path, name: str, fault: str) -> None:
    install(site, "own-planner", "own_planner/__init__.py", requires=("mujoco",))
    install(site, "own-environments", "own_environments/__init__.py")
    points = "[gymnasium.envs]\nglider = own_environments:register\n"
    (site / "own_environments-1.0.dist-info/entry_points.txt").write_text(points)
    with pytest.raises(ConfigError, match=fault):
        files_of([name])


def test_a_folder_that_another_distribution_shares_is_not_shown(site: Path) -> None:
    install(site, "own-tool", "shared_tools/one.py")
    install(site, "their-simulator", "shared_tools/simulator.py")
    with pytest.raises(ConfigError, match="shared_tools belongs to their-simulator too"):
        check_alone(["own-tool"])


def test_a_worker_with_other_packages_is_refused_with_the_option_to_give() -> None:
    from evopolicy_common.messages.worker import Fingerprint, Register
    from evopolicy_coordinator.server.request_checks import check_packages

    def worker(names: tuple[str, ...]) -> Register:
        found = Fingerprint(code_version="1", python=sys.version[:4], packages=policy_versions(names), cpu="")
        given = {"tiers": (), "environments": (), "fingerprint": found}
        return Register(token="", worker="w", protocol=1, slots=1, **given)

    check_packages(worker(()), ("numpy",))
    check_packages(worker(("scipy",)), ("numpy", "scipy"))
    with pytest.raises(RefusedError, match="start the worker with --policy-package scipy"):
        check_packages(worker(()), ("numpy", "scipy"))
    others = "scipy besides numpy, in this cluster none: start the worker without"
    with pytest.raises(RefusedError, match=others):
        check_packages(worker(("scipy",)), ("numpy",))
