"""Definitions of environments: rows of the catalogue, or anyone's environment files. Parsed, never run.

An environment file is TOML: one environment with the keys of `Entry`, or several under `[[environment]]`. `task_file`,
in place of `task`, names a text file beside it.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_common.regular_files import read_given

Demand = Literal["synthesis", "tuning"]
ObservationKind = Literal["state", "image", "symbolic", "dict"]
ActionKind = Literal["discrete", "continuous"]

USUAL_STEPS = 1000
"""Step limit of an environment that states none, as in the published software."""
USUAL_STEP_BYTES = 1000
"""Bytes of one step in a run directory, where no measurement exists."""
MAX_STEPS = 1 << 22
MAX_TASK_CHARACTERS = 64 << 10
MAX_FILE_BYTES = 1 << 20
MAX_DATA = 32
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*([/:][A-Za-z0-9][A-Za-z0-9_.-]*){0,3}(@w[1-9][0-9]?)?")
_MAX_ID = 120
_MAX_REWARD_TEXT = 1000


class Wrapper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A wrapper around an environment."""

    wrapper: str
    """Name of a class in `gymnasium.wrappers`, or `module:Class`."""
    kwargs: dict[str, Any] = {}


class Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One environment of the catalogue, or of an environment file."""

    id: str
    """Suite id by which users, runs and cases name it, such as `gym/acrobot`."""
    gymnasium_id: str | None = None
    """The argument of `gymnasium.make`, `module:Id` if a module registers it on import; None for our own (`toy/…`)."""
    family: str = "other"
    """Key of the family in which the environment's scores are averaged, such as `gym_box2d`."""
    title: str = ""
    """Short name for tables, such as `Acrobot`; empty: the id."""
    max_episode_steps: int = 0
    """Upper bound on an episode's length, steps; 0: as Gymnasium registers it, or `USUAL_STEPS` if it states none."""
    published_steps: int | None = None
    """Where the published software cuts an episode, steps, and which limit it reports; None: as here. It uses 1,000
    where Gymnasium registers no limit, though all but one of these environments end earlier by themselves."""
    step_bytes: int = USUAL_STEP_BYTES
    """Approximate measured size of one step in a train episode's feedback, without video, bytes."""
    observation: ObservationKind | None = None
    """Form of an observation: a vector, a picture, a grid of symbols, or a dictionary of arrays."""
    action: ActionKind | None = None
    demand: Demand | None = None
    """Task-demand group of the paper's mechanism section; None when the paper does not assign one."""
    adapter: str = "foreign"
    """Module of the worker's environments that plays it."""
    kwargs: dict[str, Any] = {}
    """Keyword arguments of `gymnasium.make`."""
    reset_options: dict[str, Any] = {}
    """The `options` of every `reset`; those of a case come on top."""
    wrappers: tuple[Wrapper, ...] = ()
    """Wrappers around the environment, the innermost first."""
    task: str = ""
    """Markdown for agents; empty: the text written for the id, or else one generated from documentation and spaces."""
    reward_components: dict[str, str] = {}
    """Names under which `info`, or its `rewards`, reports parts of the reward, and what each stands for."""
    reward_vector: tuple[str, ...] = ()
    """Names of the elements of a vector reward."""
    reward_weights: dict[str, float] = {}
    """Weights of these elements in the return; empty: each counts 1."""
    success: str = ""
    """Key in `info` that reports whether the task was solved; empty when no key does."""
    success_at: Literal["end", "any"] = "end"
    """Whether only the last step's value counts, or a true value at any step."""
    deterministic: bool = True
    """False when even a fresh environment does not repeat an episode from its seed and actions."""
    data: tuple[str, ...] = ()
    """Files and folders besides its modules, relative to its file; read from a file, absolute."""
    world: int = 0
    """Which world of an environment it is (see `worlds`); 0: the environment itself."""
    info_strings: tuple[str, ...] = ()
    """Keys of info whose texts feedback has; an environment's other texts are left out."""

    @property
    def label(self) -> str:
        """Short name for tables."""
        return self.title or self.id

    def feedback_bytes(self, episodes: int) -> int:
        """Size of the feedback of that many train episodes in a run directory if all have maximal length, bytes."""
        return episodes * (self.max_episode_steps or USUAL_STEPS) * self.step_bytes


_SHIPPED_ONLY = ("published_steps", "step_bytes", "observation", "action", "demand", "adapter", "world")
"""Fields that environment files may not set."""


class _Many(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    environment: tuple[dict[str, Any], ...]


def valid_id(env_id: str) -> bool:
    """Whether an id is valid in messages and as the name of a folder."""
    return len(env_id) <= _MAX_ID and _ID.fullmatch(env_id) is not None


def folder_name(env_id: str) -> str:
    """The name of files and folders of an environment, without characters that other systems forbid."""
    return re.sub("[/:]", "_", env_id)


def policy_folder(policies: Path, env_id: str) -> Path:
    """The folder of an environment's policy in `policies`: named as it, or as its family (before the first hyphen)."""
    name = folder_name(env_id)
    family = policies / name.partition("-")[0]
    return family if family.is_dir() and not (policies / name).is_dir() else policies / name


def read_file(path: Path) -> tuple[Entry, ...]:
    """The environments of a file. Raises ConfigError that names file, environment, field and remedy."""
    data = read_given(path, f"environment file {path}", MAX_FILE_BYTES)
    try:
        table = tomllib.loads(data.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"environment file {path} is not TOML: {error}") from error
    tables = [table]
    if "environment" in table:
        remedy = "several environments are [[environment]] tables"
        with raised_as(ConfigError, f"environment file {path}", msgspec.ValidationError, remedy=remedy):
            tables = list(msgspec.convert(table, _Many).environment)
    entries = tuple(_entry(path, each) for each in tables)
    if doubled := sorted(name for name, n in Counter(each.id for each in entries).items() if n > 1):
        names = ", ".join(doubled)
        raise ConfigError(f"environment file {path} defines {names} more than once: keep one of each")
    return entries


def _entry(path: Path, table: dict[str, object]) -> Entry:
    fields = dict(table)
    where = f"environment file {path}, environment {fields.get('id', 'without id')!s:.80}"
    known = [name for name in Entry.__struct_fields__ if name not in _SHIPPED_ONLY] + ["task_file"]
    for name in fields:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            more = f"near: {near[0]}" if near else f"keys are {', '.join(known)}"
            raise ConfigError(f"{where}: unknown key {name!r}; {more}")
    task_file = fields.pop("task_file", None)
    if task_file is not None:
        fields["task"] = _task(where, path, fields, task_file)
    with raised_as(ConfigError, where, msgspec.ValidationError):
        entry = msgspec.convert(fields, Entry)
    entry = msgspec.structs.replace(entry, data=_data(where, path, entry.data))
    if why := _fault(entry):
        raise ConfigError(f"{where}: {why}")
    return entry


def _task(where: str, path: Path, fields: dict[str, object], task_file: object) -> str:
    if "task" in fields:
        raise ConfigError(f"{where}: task and task_file exclude each other: give only one of them")
    if not isinstance(task_file, str):
        raise ConfigError(
            f"{where}: task_file is {task_file!r:.80}: it has to name a text file in this file's folder"
        )
    what = f"{where}: task_file {task_file!r}"
    folder = path.parent.resolve()
    try:
        place = (folder / task_file).resolve()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{what} cannot be read: {error}") from error
    # Agents read the text: a package's file must not name a secret of this machine.
    if not place.is_relative_to(folder):
        raise ConfigError(
            f"{what} is {place}, outside the environment file's folder {folder}: copy the text into that folder"
        )
    with raised_as(ConfigError, f"{what} is not UTF-8", UnicodeDecodeError, remedy="save it as UTF-8"):
        return read_given(place, what, MAX_FILE_BYTES).decode()


def _data(where: str, path: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    if len(names) > MAX_DATA:
        raise ConfigError(
            f"{where}: data has {len(names)} names; {MAX_DATA} are the limit: name their folder"
        )
    folder = path.parent.resolve()
    paths: list[str] = []
    for name in names:
        place = folder / name
        real = place.resolve() if "\0" not in name else folder
        parts = (*Path(name).parts, *real.parts[len(folder.parts) :])
        hidden = any(part.startswith(".") for part in parts)
        if real == folder or not real.is_relative_to(folder) or hidden:
            raise ConfigError(
                f"{where}: data {name[:80]!r}: name files and folders in the environment file's folder, relative to it"
                " and without a dot at the beginning"
            )
        if not real.exists():
            raise ConfigError(f"{where}: data {name[:80]!r}: there is no {place}")
        paths.append(str(path.parent.absolute() / name))
    return tuple(paths)


def _fault(entry: Entry) -> str:
    """The fault of a foreign definition; empty if it has none."""
    names = (entry.success, *entry.reward_components, *entry.reward_vector, *entry.info_strings)
    long_name = next((name for name in names if len(name) > _MAX_ID or not name.isprintable()), None)
    long_text = next((text for text in entry.reward_components.values() if len(text) > _MAX_REWARD_TEXT), "")
    if not valid_id(entry.id) or "@" in entry.id:  # worlds ship
        rule = f"letters, digits, '_', '.', '-', parts joined by '/' or ':', {_MAX_ID} characters at most"
        return f"id {entry.id[:80]!r}: {rule}"
    if not entry.gymnasium_id:
        return "gymnasium_id is missing: what gymnasium.make takes, such as my_pkg:MyEnv-v0"
    if not 0 <= (steps := entry.max_episode_steps) <= MAX_STEPS:
        return f"max_episode_steps is {steps}: 1 to {MAX_STEPS:,}, or 0 for what Gymnasium registers"
    if len(entry.task) > MAX_TASK_CHARACTERS:
        return f"the task text has {len(entry.task):,} characters; {MAX_TASK_CHARACTERS:,} are the limit"
    if not re.fullmatch(r"[a-z0-9_]{1,40}", entry.family):
        return f"family {entry.family[:80]!r}: lowercase letters, digits and '_', 40 at most"
    if long_name is not None:
        where = "success, reward_components, reward_vector and info_strings"
        return f"key of info {long_name[:80]!r}: one line of {_MAX_ID} characters at most, in {where}"
    if long_text:
        limit = f"{_MAX_REWARD_TEXT:,} characters at most"
        return f"reward_components, text {long_text[:80]!r}…: {limit}; shorten it"
    if unknown := sorted(entry.reward_weights.keys() - set(entry.reward_vector)):
        return f"reward_weights names {', '.join(unknown)}, which reward_vector does not have"
    if not all(map(math.isfinite, entry.reward_weights.values())):
        return f"reward_weights {entry.reward_weights}: weights have to be finite numbers"
    if len(entry.title) > _MAX_ID or not entry.title.isprintable():
        return f"title {entry.title[:80]!r}: one line of {_MAX_ID} characters at most"
    for name in ("kwargs", "reset_options"):
        if not _is_plain(getattr(entry, name)):
            return f"{name}: finite numbers, texts, lists and tables only, no dates"
    if not all(_is_plain(each.kwargs) for each in entry.wrappers):
        return "wrappers.kwargs: finite numbers, texts, lists and tables only"
    return ""


def _is_plain(value: object) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(map(_is_plain, value))
    # Neither infinities nor longer numbers survive the way to the worker's process.
    if isinstance(value, int):
        return -(2**63) <= value < 2**63
    return isinstance(value, str) or (isinstance(value, float) and math.isfinite(value))
