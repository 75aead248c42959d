"""Options of commands, made from their declarations (`evopolicy_gateway/declared.py`), and their cluster.

A command takes a Struct of options as one parameter, `Annotated[…, Shown(…)]` where its options differ, or a single one
as `Annotated[type, Of(Struct)]`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import msgspec
import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.packages import checked_names
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_gateway.declared import SAME, SET, Declared, Several, declared, set_values
from evopolicy_gateway.operator.cluster import ChosenCluster
from evopolicy_gateway.run.run_options import ClusterOptions

RUN, CLUSTER = "Run", ClusterOptions.group

Env = Annotated[
    str, typer.Option(help="Suite id, such as gym/acrobot.", show_default=False, rich_help_panel=RUN)
]
Envs = Annotated[
    list[str],
    typer.Option(
        help="Suite (core16), suite id, glob (gymnasium/MiniGrid-*), environment file or module:Id; may be repeated.",
        show_default=False,
        rich_help_panel=RUN,
    ),
]
Local = Annotated[
    bool,
    typer.Option(
        "--local",
        help="Start a cluster on this machine, as `evopolicy local` does.",
        rich_help_panel=CLUSTER,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON; progress goes to stderr.")]
_LOCAL_ONLY = {
    "hidden_isolation": "--hidden-isolation applies only to a cluster started by this command; otherwise set it at the"
    " coordinator: evopolicy-coordinator --hidden-isolation",
    "policy_package": "--policy-package is for a cluster that this command brings up; give it to"
    " evopolicy-coordinator and to each evopolicy-worker",
    **dict.fromkeys(
        ("env_timeout", "env_memory"),
        "env_timeout and env_memory are for a cluster that this command starts; give --env-timeout and --env-memory"
        " to each evopolicy-worker",
    ),
}
"""Refusals of options of a local cluster where another one is used."""


def cluster_of(
    given: ClusterOptions, connect: list[str] | None, file: Path | None, *, local: bool | None = None
) -> ChosenCluster:
    """The cluster that a command plays on; `local` None: its own unless one is named. ConfigError for an option that
    does not go with it."""
    local = not (connect or file) if local is None else local
    packages = list(checked_names(given.policy_package))
    if not local:
        for name, text in _LOCAL_ONLY.items():
            if getattr(given, name):
                raise ConfigError(text)
        return ChosenCluster(connect=tuple(connect or ()), file=file)
    if given.fresh and given.state is not None:
        raise ConfigError(f"--fresh and --state {given.state}: give only one of them")
    state = None if given.fresh else given.state or local_state_dir()
    return ChosenCluster(local=msgspec.structs.replace(given, state=state, policy_package=packages))


class Shown(NamedTuple):
    """How a command's options differ from the declared ones."""

    without: Collection[str] = ()
    help: Mapping[str, str] = {}


class Of(NamedTuple):
    """The parameter is the option of its name in this class."""

    options: type[msgspec.Struct]


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer is to see it: with an option for each parameter and each field of a Struct. Our errors end
    it with one line."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[Any, list[str]]] = {}
    parsed: dict[str, Callable[[Any], Any]] = {}
    rare: dict[str, Declared] = {}
    fields_of: dict[str, list[str]] = {}
    for each in inspect.signature(command, eval_str=True).parameters.values():
        kind, note = each.annotation, None
        if get_origin(kind) is Annotated:
            kind, note = get_args(kind)[:2]
        if isinstance(note, Of):
            options, shown = [declared(note.options)[each.name]], Shown()
        elif inspect.isclass(kind) and issubclass(kind, msgspec.Struct):
            shown = note or Shown()
            chosen = [one for one in declared(kind).values() if one.name not in shown.without]
            options = [one for one in chosen if not one.option.by_set]
            groups[each.name] = (kind, [one.name for one in options])
            rare |= {one.name: one for one in chosen if one.option.by_set}
            fields_of[each.name] = [one.name for one in chosen if one.option.by_set]
        else:
            parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        parameters += [_parameter(one, shown.help.get(one.name, one.help)) for one in options]
        parsed |= {one.name: one.option.parse for one in options if one.option.parse is not None}

    if rare:
        text = f"A further setting (docs/reference/options.md): {', '.join(rare)}; may be repeated."
        shown = typer.Option(SET, metavar="NAME=VALUE", help=text, show_default=False, rich_help_panel=RUN)
        several: Any = Annotated[Several, shown]
        only = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter("set_", only, default=None, annotation=several))

    def flat(**values: Any) -> None:
        with fail_on_our_errors():
            further = set_values(rare, values.pop("set_", None) or ())
            for name, parse in parsed.items():
                values[name] = parse(values[name] or ())
            for name, (group, fields) in groups.items():
                given = {field: values.pop(field) for field in fields}
                set_here = {field: further[field] for field in fields_of[name] if field in further}
                values[name] = group(**given, **set_here)
            command(**values)

    flat.__name__, flat.__doc__ = command.__name__, command.__doc__
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {each.name: each.annotation for each in parameters}
    return flat


def _parameter(one: Declared, text: str) -> inspect.Parameter:
    option = one.option
    kind = one.type if option.command is SAME else option.command
    default = inspect.Parameter.empty if one.default is msgspec.NODEFAULT else one.default
    shown = typer.Option(
        one.flag,
        min=one.bounds.ge,
        max=one.bounds.le,
        metavar=option.metavar,
        help=f"{text.rstrip('.')}; may be repeated." if kind == Several else text,
        rich_help_panel=one.group,
        show_default=one.default is not msgspec.NODEFAULT,
    )
    return inspect.Parameter(
        one.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None if option.parse else default,
        annotation=Annotated[kind, shown],
    )
