"""Files of single installed packages, for jails that show those alone and never a folder of all installed packages.

Only a worker's environment process may have packages that simulate (`SIMULATORS`): with one of them a policy could look
ahead, and an agent could train outside its budget. The sandboxes of policies and the jails of agents hide them.
"""

from __future__ import annotations

import functools
import importlib.util
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path

from evopolicy_common.catalogue import ENTRY_POINTS
from evopolicy_common.catalogue.installs import installs
from evopolicy_common.errors import ConfigError

_OTHERS = "gym mujoco_py box2d browsergym pettingzoo labmaze shimmy pybullet pybullet_envs retro"
"""Those that no family of the catalogue imports."""
SIMULATORS = tuple(sorted({*_OTHERS.split(), *(name for row in installs().values() for name in row.modules)}))
"""Import names, or names of their files in a Python installation."""


POLICY = "policy"
"""Name in a fingerprint of the packages that policies may import."""
_ENVIRONMENTS = ("gymnasium.envs", ENTRY_POINTS)
"""Groups of entry points with which packages offer environments."""
_NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9._-]*[A-Za-z0-9_])?")
_NO_CODE = (".dist-info", ".egg-info", ".pth")
_NOT_IN_SITE = ("..", "__pycache__", "bin")


def checked_names(requested: Iterable[str] | None) -> tuple[str, ...]:
    """The values of `--policy-package`, sorted, each once. Raises ConfigError for one that is no name of a package."""
    names = tuple(sorted(set(requested or ())))
    for name in names:
        _check_name(name)
    return names


def files_of(names: Iterable[str], *, metadata_too: bool = False) -> dict[str, str]:
    """Modules, packages and bundled libraries of the named distributions (or import names), and of those that they
    require: name in the packages folder → path on this machine. Required distributions that are not installed are left
    out. `metadata_too`: with the folders by which libraries find versions, their own and others'.

    Raises ConfigError that names the package when it is not installed, or is or requires a simulator.
    """
    wanted = tuple(names)
    paths: dict[str, str] = {}
    distributions: set[str] = set()
    pending = [(name, name) for name in wanted]
    while pending:
        name, requested = pending.pop()
        if name in distributions:
            continue
        distributions.add(name)
        if name == "numpy":
            # The usual case, without reading the metadata of a distribution.
            spec = importlib.util.find_spec("numpy")
            if spec is None or not spec.submodule_search_locations:
                raise ConfigError("numpy is not installed; install evopolicy again")
            folder = Path(next(iter(spec.submodule_search_locations)))
            both = [folder, folder.with_name("numpy.libs")]
            paths |= {path.name: str(path) for path in both if path.is_dir()}
            continue
        tops, needs = _one(name, requested, required=name in wanted, metadata_too=metadata_too)
        paths |= tops
        pending += [(need, requested) for need in needs]
    return paths


def check_alone(names: Iterable[str]) -> None:
    """Raises ConfigError when other distributions have files in the folders of these: they would be shown with them."""
    tops, known = files_of(names), {canonical(name) for name in versions_of(names)}
    for top in tops:
        if others := sorted(owner for owner in _owners().get(top, ()) if canonical(owner) not in known):
            raise ConfigError(
                f"the folder {top} belongs to {', '.join(others)} too, and cannot be shown alone"
            )


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Versions of the named distributions and of those that they require, by distribution. Raises as `files_of`."""
    versions: dict[str, str] = {}
    pending = list(names)
    while pending:
        distribution = _distribution(pending.pop())
        if distribution is not None and distribution.metadata["Name"] not in versions:
            versions[distribution.metadata["Name"]] = distribution.version
            pending += _requires(distribution)
    return dict(sorted(versions.items()))


def policy_versions(names: Iterable[str]) -> dict[str, str]:
    """Entries of a fingerprint for policies' packages besides numpy. Raises as `files_of`."""
    requested = sorted(set(names))
    if not requested:
        return {}
    files_of(requested)
    versions = {f"{POLICY}:{name}": version for name, version in versions_of(requested).items()}
    versions.pop(f"{POLICY}:numpy", None)
    return {POLICY: ",".join(requested), **versions}


def packages_in(fingerprint: Mapping[str, str]) -> tuple[str, ...]:
    """The packages besides numpy that policies could import, from the fingerprint in a run's `run.json`."""
    return tuple(name for name in fingerprint.get(POLICY, "").split(",") if name)


def modules_of(names: Iterable[str]) -> list[str]:
    """Import names of the named distributions (or import names): scikit-learn is imported as `sklearn`."""
    modules: list[str] = []
    for name in names:
        if name.isidentifier() and importlib.util.find_spec(name) is not None:
            modules.append(name)
            continue
        tops, _ = _one(name, name, required=True, metadata_too=False)
        modules += [
            top for top, path in tops.items() if top.isidentifier() and Path(path, "__init__.py").is_file()
        ]
        modules += [top.removesuffix(".py") for top in tops if top.endswith(".py")]
    return modules


def _check_name(name: str) -> None:
    # A run.json may be untrusted and name anything; the name appears in a command for the user to copy.
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{name!r} is no name of a package; leave it out")


def _one(
    name: str, requested: str, *, required: bool, metadata_too: bool
) -> tuple[dict[str, str], list[str]]:
    """Folders and modules of one distribution, and what it requires."""
    if required:
        _check_name(name)
    distribution = _distribution(name)
    if distribution is None:
        if required:
            raise ConfigError(
                f"package {name!r} is not installed here; install it with `{sys.executable} -m pip install {name}`,"
                " or leave it out"
            )
        return {}, []
    tops = {file.parts[0] for file in distribution.files or () if file.parts[0] not in _NOT_IN_SITE}
    entries = {
        top: str(distribution.locate_file(top))
        for top in sorted(tops)
        if not top.endswith(".pth" if metadata_too else _NO_CODE)
    }
    simulators = {top.partition(".")[0] for top in entries} & set(SIMULATORS)
    simulators |= {point.name for point in distribution.entry_points if point.group in _ENVIRONMENTS}
    simulators |= {"evopolicy"} if canonical(distribution.metadata["Name"]) == "evopolicy" else set()
    if simulators:
        which = "is" if name == requested else f"requires {name}, which is"
        raise ConfigError(
            f"package {requested!r} {which} a simulator ({min(simulators)}); no policy or agent may see one"
        )
    return entries, _requires(distribution)


def _distribution(name: str) -> metadata.Distribution | None:
    """The installed distribution of that name, or of the package of that import name."""
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        owner = distribution_of(name)
        return metadata.distribution(owner) if owner else None


@functools.cache
def distribution_of(module: str) -> str:
    """Name of the first installed distribution with that top-level module, as `metadata.packages_distributions` has it;
    empty if there is none."""
    for distribution in metadata.distributions():
        modules = (distribution.read_text("top_level.txt") or "").split() or {
            path.partition("/")[0].removesuffix(".py")
            for path in _paths(distribution)
            if path.endswith(".py")
        }
        if module in modules:
            return distribution.metadata["Name"]
    return ""


def _paths(distribution: metadata.Distribution) -> Iterator[str]:
    """Paths of its files as texts: objects for the files of all distributions would take seconds."""
    for line in (distribution.read_text("RECORD") or "").splitlines():
        yield line.strip('"').partition(",")[0]


def _requires(distribution: metadata.Distribution) -> list[str]:
    return [
        re.split(r"[\s;<>=!~\[(]", requirement, maxsplit=1)[0]
        for requirement in distribution.requires or ()
        if "extra ==" not in requirement
    ]


@functools.cache
def _owners() -> dict[str, set[str]]:
    """Distributions by the top-level names of their files."""
    owners: dict[str, set[str]] = {}
    for distribution in metadata.distributions():
        for top in {path.partition("/")[0] for path in _paths(distribution)}:
            if top not in _NOT_IN_SITE and not top.endswith(_NO_CODE):
                owners.setdefault(top, set()).add(distribution.metadata["Name"])
    return owners


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
