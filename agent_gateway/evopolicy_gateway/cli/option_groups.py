"""Options of commands, made from their declarations (`evopolicy_gateway/declared.py`).

A command takes a Struct of options as one parameter, `Annotated[…, Shown(…)]` where its options differ, or a single one
as
`Annotated[type, Of(Struct)]`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import msgspec
import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_gateway.declared import SAME, Declared, Several, declared


class Shown(NamedTuple):
    """How a command's options differ from the declared ones."""

    without: Collection[str] = ()
    help: Mapping[str, str] = {}


class Of(NamedTuple):
    """The parameter is the option of its name in this class."""

    options: type[msgspec.Struct]


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer is to see it: with an option for each parameter and each field of a Struct."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[Any, list[str]]] = {}
    parsed: dict[str, Callable[[Any], Any]] = {}
    for each in inspect.signature(command, eval_str=True).parameters.values():
        kind, note = each.annotation, None
        if get_origin(kind) is Annotated:
            kind, note = get_args(kind)[:2]
        if isinstance(note, Of):
            options, shown = [declared(note.options)[each.name]], Shown()
        elif inspect.isclass(kind) and issubclass(kind, msgspec.Struct):
            shown = note or Shown()
            options = [one for one in declared(kind).values() if one.name not in shown.without]
            groups[each.name] = (kind, [one.name for one in options])
        else:
            parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        parameters += [_parameter(one, shown.help.get(one.name, one.help)) for one in options]
        parsed |= {one.name: one.option.parse for one in options if one.option.parse is not None}

    def flat(**values: Any) -> None:
        with fail_on_our_errors():
            for name, parse in parsed.items():
                values[name] = parse(values[name] or ())
        for name, (group, fields) in groups.items():
            values[name] = group(**{field: values.pop(field) for field in fields})
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
        option.flag or f"--{one.name.replace('_', '-')}",
        min=one.bounds.ge,
        max=one.bounds.le,
        metavar=option.metavar,
        help=f"{text.rstrip('.')}; may be repeated." if kind == Several else text,
        rich_help_panel=one.group,
        exists=option.exists,
        dir_okay=not option.exists,
        show_default=one.default is not msgspec.NODEFAULT,
    )
    return inspect.Parameter(
        one.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None if option.parse else default,
        annotation=Annotated[kind, shown],
    )
