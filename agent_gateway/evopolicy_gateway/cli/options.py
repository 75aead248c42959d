"""Options that several commands share, and how their values become settings. A wrong value is a ConfigError."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, ProtocolError, RequestError
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, ResourceLimits, Tier
from evopolicy_common.messages.gateway import Profile
from evopolicy_common.messages.run_settings import PUBLISHED, RunSettings, episode_counts
from evopolicy_common.processes.packages import checked_names, packages_in, policy_versions
from evopolicy_common.records.run_files import read_record
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_gateway.http.submit_request import Bounds, ids_in

RUN, SCORE, POLICY, AGENT, JAIL, REMOTE, CLUSTER = (
    "Run",
    "Score",
    "Policy and feedback",
    "Agent",
    "Agent's jail",
    "Remote agent (--agent remote)",
    "Local cluster",
)
"""Groups of options in the commands' help, in the order in which they stand there."""

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON; progress goes to stderr.")]
Slots = Annotated[
    int,
    typer.Option(
        min=1,
        max=1024,
        help="Episodes that the local worker plays at the same time. Environments in a virtual environment of their"
        " own have a worker with as many.",
        rich_help_panel=CLUSTER,
    ),
]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=VALUE",
        help="Limit for the policy, such as act_wall_s=5 or memory_bytes=2e9; may be repeated.",
        rich_help_panel=POLICY,
    ),
]
DataFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder of split files (`evopolicy data make`); default: derived from the state's secret.",
        rich_help_panel=CLUSTER,
    ),
]
StateFolder = Annotated[
    Path | None,
    typer.Option(
        help="State folder of the local cluster. Default: $XDG_STATE_HOME/evopolicy/local, which all your local runs share, so"
        " that they have the same cases.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
Fresh = Annotated[
    bool,
    typer.Option(
        "--fresh",
        help="Use a temporary state folder: new cases, and no later comparison or `verify`.",
        rich_help_panel=CLUSTER,
    ),
]
TierName = Annotated[Tier, typer.Option(help="Sandbox around the policy.", rich_help_panel=POLICY)]
Audit = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="SHARE",
        rich_help_panel=CLUSTER,
        help="Share of the episodes whose actions a second local worker replays, compared bit for bit.",
    ),
]

Web = Annotated[
    bool,
    typer.Option(
        "--web",
        help="Show the runs live in a browser, at the address that is printed. See `evopolicy web`.",
        rich_help_panel=RUN,
    ),
]

HiddenIsolation = Literal["related", "strict", "off"]
Isolation = Annotated[
    HiddenIsolation | None,
    typer.Option(
        "--hidden-isolation",
        help="Agents beside which no hidden episode is played on a kernel: those of runs with the same hidden cases (related, the"
        " default), all (strict), or none (off).",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
PolicyPackages = Annotated[
    list[str] | None,
    typer.Option(
        "--policy-package",
        metavar="NAME",
        help="Package that policies may import in addition to numpy; may be repeated.",
        rich_help_panel=CLUSTER,
    ),
]
Browser = Annotated[
    Path | None,
    typer.Option(
        exists=True,
        dir_okay=False,
        help="Chromium's program for the local worker's web pages; default: the machine's own.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
HiddenCasesOption = Annotated[
    Literal["shared", "per-run"] | None,
    typer.Option(
        "--hidden-cases",
        help="shared: the same for all runs of an environment (default); per-run: the run's own, so that runs cannot be paired.",
        rich_help_panel=SCORE,
        show_default=False,
    ),
]


ProfileOption = Annotated[
    Literal["published"] | None,
    typer.Option(
        help="published: all settings of the published protocol (docs/reference/protocol.md), with its case files in --data.",
        rich_help_panel=RUN,
        show_default=False,
    ),
]
OWN = {
    "policy_scope": "episode",
    "observations": "arrays",
    "simulation": "forbidden",
    "finish": "early",
    "step_limit": "published",
    "hidden_cases": "shared",
    "feedback": "pictures",
}
"""Defaults of settings that neither an option nor a profile gives."""


def settings_of(profile: str | None, **given: str | None) -> dict[str, str]:
    """The settings that a profile decides, and the profile; `given` by name of `RunSettings`, None for what was not given.

    ConfigError for a profile that there is not, or that sets otherwise what was given.
    """
    chosen = one_of("--profile", profile or "own", Profile)
    usual = PUBLISHED if chosen == "published" else OWN
    for name, value in given.items():
        if chosen == "published" and value not in (None, usual[name]):
            raise ConfigError(
                f"profile published has {name} = {usual[name]}, but {value} was given: drop one of them"
            )
    return usual | {name: value for name, value in given.items() if value is not None} | {"profile": chosen}


def run_settings(given: Any, limits: ResourceLimits, **named: Any) -> RunSettings:
    """The settings of one run. `given`: the options of `run`, or a table of a suite, which have the same names; None
    for options that were not given. Raises ConfigError that names the invalid option."""
    names = ("policy_scope", "observations", "simulation", "finish", "step_limit", "feedback")
    chosen: dict[str, Any] = settings_of(
        given.profile,
        hidden_cases=hidden_cases_of(given.hidden_cases),
        **{name: getattr(given, name) for name in names},
    )
    if chosen["feedback"] != "pictures" and given.video not in (None, "off"):
        raise ConfigError(
            f"feedback {chosen['feedback']} shows no videos, and video {given.video} is asked for: leave out one of them"
        )
    settings = RunSettings(
        budget=given.budget,
        min_episodes_per_submit=given.min_episodes,
        max_episodes_per_submit=given.max_episodes,
        n_validation=given.validation,
        n_heldout=given.heldout,
        sandbox_tier=given.tier or "bwrap",
        video=given.video or "off",
        replays=given.replays,
        limits=limits,
        definition=catalogue.pinned(named["env"]),
        **chosen,
        **named,
    )
    episode_counts(settings, catalogue.suite_of(settings.env))
    return settings


def state_of(state: Path | None, *, fresh: bool) -> Path | None:
    """The state folder of a local cluster; None for a temporary one. Raises ConfigError when both options are given."""
    if fresh and state is not None:
        raise ConfigError(f"--fresh and --state {state}: give only one of them")
    return None if fresh else state or local_state_dir()


def default_exp_id() -> str:
    """From the time, so that every run has a folder of its own."""
    return time.strftime("%Y%m%d-%H%M%S")


def one_environment(env: str) -> str:
    """The suite id that `env` names. ConfigError when it names none or several."""
    found = catalogue.resolve([env])
    if len(found) != 1:
        raise ConfigError(f"--env {env} names {len(found)} environments; this command takes one")
    return found[0]


def limits_of(texts: Sequence[str]) -> ResourceLimits:
    """`NAME=VALUE` texts over the usual limits."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--limit {text!r}: use the form NAME=VALUE")
        try:
            values[name] = float(value)
        except ValueError:
            raise ConfigError(f"--limit {text!r}: {value!r} is not a number") from None
    return limits_from(values, "--limit ")


def limits_from(values: Mapping[str, float], prefix: str) -> ResourceLimits:
    """Limits by their names over the usual ones. ConfigError for one that cannot be; `prefix`: how an error begins."""
    usual = ResourceLimits()
    typed: dict[str, float | int] = {}
    for name, number in values.items():
        what = f"{prefix}{name}={number:g}"
        if name not in usual.__struct_fields__:
            raise ConfigError(f"{what}: unknown limit; the limits are {', '.join(usual.__struct_fields__)}")
        if not 0 < number < float("inf"):
            raise ConfigError(f"{what}: a limit must be a finite number above 0")
        if number > (most := LARGEST_LIMITS.get(name, LARGEST_LIMIT)):
            raise ConfigError(f"{what}: {name} can be {most:,} at most")
        typed[name] = int(number) if isinstance(getattr(usual, name), int) else number
    return msgspec.structs.replace(usual, **typed)


def cases_of(text: str) -> tuple[int, ...]:
    """Case ids of a text such as `0-3,7`."""
    # How many cases there are, the coordinator knows; here only nonsense is kept out.
    bounds = Bounds(n_env_instances=10**6, min_episodes=1, max_episodes=4096, remaining_budget=4096)
    try:
        ids = ids_in(text, bounds)
    except RequestError as error:
        raise ConfigError(f"--cases {text!r}: {error.message.replace('env_instances', 'it')}") from error
    if not ids:
        raise ConfigError(f"--cases {text!r} names no case; use a form such as 0-3,7")
    return ids


def check_packages(requested: list[str] | None, *, local: bool) -> tuple[str, ...]:
    """The packages of `--policy-package`. ConfigError for a cluster that is not brought up here."""
    names = checked_names(requested)
    if names and not local:
        raise ConfigError(
            "--policy-package is for a cluster that this command brings up; give it to evopolicy-coordinator and to each"
            " evopolicy-worker"
        )
    return names


def packages_for(policy: Path, requested: Sequence[str] | None) -> tuple[str, ...]:
    """The packages of `--policy-package`; where it is not given, those of the run to whose directory the policy belongs.

    Raises ConfigError when policies cannot have one of those."""
    if requested:
        return checked_names(requested)
    folder = policy.absolute()
    for run in (folder, *list(folder.parents)[:2]):
        with contextlib.suppress(OSError, ProtocolError):
            found = packages_in(read_record(run).versions.fingerprint)
            try:
                policy_versions(found)
            except ConfigError as error:
                raise ConfigError(
                    f"{run / 'run.json'} names packages of its policies: {error}; --policy-package names others in their place"
                ) from error
            return found
    return ()


def check_browser(requested: Path | None, *, local: bool) -> Path | None:
    """The browser of `--browser`. ConfigError for a cluster that is not brought up here."""
    if requested is not None and not local:
        raise ConfigError(
            "--browser is for a cluster that this command brings up; give it to each evopolicy-worker"
        )
    return None if requested is None else requested.absolute()


def check_isolation(requested: HiddenIsolation | None, *, local: bool) -> None:
    """ConfigError where `--hidden-isolation` is given for a cluster that is not brought up here."""
    if requested is not None and not local:
        raise ConfigError(
            "--hidden-isolation applies only to a cluster started by this command; otherwise set it at the coordinator:"
            " evopolicy-coordinator --hidden-isolation"
        )


def hidden_cases_of(text: str | None) -> str | None:
    """The hidden cases that `--hidden-cases` names, if it does. ConfigError when there are none of that name."""
    if text is None:
        return None
    return one_of("--hidden-cases", text, Literal["shared", "per-run"]).replace("-", "_")


def one_of(option: str, text: str, kind: object) -> str:
    """`text`, which is one of the values of the Literal `kind`. ConfigError naming `option` when it is not."""
    allowed = get_args(kind)
    if text not in allowed:
        raise ConfigError(f"{option} {text!r}: there are {', '.join(allowed)}")
    return text
