"""Options that several commands share, written once: a Struct whose fields are options, taken by a command as one value."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

import msgspec


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer is to see it: in place of each parameter that is a Struct stand the Struct's fields.

    A field is an option as a parameter is: `Annotated[type, typer.Option(...)]`, with its default.
    """
    given = inspect.signature(command, eval_str=True).parameters.values()
    groups = {each.name: each.annotation for each in given if _is_group(each.annotation)}

    def flat(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field: values.pop(field) for field in group.__struct_fields__})
        command(**values)

    parameters: list[inspect.Parameter] = []
    for each in given:
        fields = _fields(groups[each.name]) if each.name in groups else (each,)
        parameters += [field.replace(kind=inspect.Parameter.KEYWORD_ONLY) for field in fields]
    flat.__name__, flat.__doc__ = command.__name__, command.__doc__
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {each.name: each.annotation for each in parameters}
    return flat


def _is_group(annotation: Any) -> bool:
    return inspect.isclass(annotation) and issubclass(annotation, msgspec.Struct)


def _fields(group: type[msgspec.Struct]) -> Iterator[inspect.Parameter]:
    annotations = get_type_hints(group, include_extras=True)
    for field in msgspec.structs.fields(group):
        default = inspect.Parameter.empty if field.required else field.default
        yield inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=annotations[field.name],
        )
