"""Options declared once: a class of options has a field for each, with its type, default, bounds (`msgspec.Meta`) and
`Option`.

Made from it: options of commands (`cli/options.py`), tables of suite files (`suite/suite_file.py`), keywords of the
package `evopolicy`, JSON Schemas, and `docs/reference/options.md`. The docstring below a field is its help; `group` of
the class is the first fields' heading.
"""

from __future__ import annotations

import ast
import difflib
import functools
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from evopolicy_common.errors import ConfigError

Several = list[str] | None
"""An option that may be repeated."""
Count = Annotated[int, Meta(ge=1)]
SAME = object()
"""A surface has the field's own type."""
SET = "--set"


class Option(msgspec.Struct, frozen=True, kw_only=True):
    """An option's surfaces, as far as the field's name and type do not give them."""

    flag: str | None = None
    """On the command line, if it is not named as the field."""
    by_set: bool = False
    """The command line takes it as `--set NAME=VALUE`: a setting that few runs change."""
    metavar: str | None = None
    command: Any = SAME
    """Type on the command line."""
    parse: Callable[[Any], Any] | None = None
    """Makes the field's value of that type's. Raises ConfigError."""
    suite: Any = SAME
    """Type of the key in suite files, None: no key. A path is a text there."""
    python: bool = True
    """Whether it is a keyword of `evopolicy.run`."""
    group: str = ""
    """The heading from this field on; empty: as before it."""


class Declared(NamedTuple):
    """A field of a class of options."""

    name: str
    type: Any
    """Without bounds."""
    bounded: Any
    """The type with them."""
    bounds: Meta
    default: Any
    """`msgspec.NODEFAULT` if it must be given."""
    help: str
    group: str
    option: Option

    @property
    def flag(self) -> str:
        """How the command line spells it."""
        if self.option.by_set:
            return f"{SET} {self.name}=…"
        return self.option.flag or f"--{self.name.replace('_', '-')}"


@functools.cache
def declared(options: type[msgspec.Struct]) -> dict[str, Declared]:
    fields, plain, noted = {}, get_type_hints(options), get_type_hints(options, include_extras=True)
    helps, group = field_texts(options), vars(options)["group"]
    for field in msgspec.structs.fields(options):
        notes = _notes(noted[field.name])
        option = next((note for note in notes if isinstance(note, Option)), Option())
        group = option.group or group
        fields[field.name] = Declared(
            field.name,
            plain[field.name],
            noted[field.name],
            next((note for note in notes if isinstance(note, Meta)), Meta()),
            field.default,
            helps[field.name],
            group,
            option,
        )
    return fields


def _notes(kind: Any) -> list[Any]:
    """The annotations of a type, those of a union's types included."""
    if get_origin(kind) is Annotated:
        return [*kind.__metadata__, *_notes(kind.__origin__)]
    return [note for each in get_args(kind) if get_origin(each) is Annotated for note in _notes(each)]


def set_values(known: Mapping[str, Declared], texts: Sequence[str]) -> dict[str, Any]:
    """The values of `NAME=VALUE` texts, of those options that have no flag. ConfigError for another name or an
    impossible value."""
    known = {name: one for name, one in known.items() if one.option.by_set}
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        one = known.get(name.strip().replace("-", "_"))
        if one is None or not equals:
            near = difflib.get_close_matches(name, known, 1)
            meant = f"did you mean {near[0]}=…? " if near else ""
            raise ConfigError(
                f"{SET} {text}: {meant}write NAME=VALUE with one of: {', '.join(sorted(known))}"
            )
        try:
            values[one.name] = msgspec.convert(value.strip(), one.bounded, strict=False, dec_hook=_path)
        except msgspec.ValidationError as error:
            allowed = [repr(each) for part in (one.type, *get_args(one.type)) for each in literals(part)]
            reason = f"use one of {', '.join(allowed)}" if allowed else error
            raise ConfigError(f"{SET} {text}: {reason}. {one.help}") from None
    return values


def literals(kind: object) -> tuple[Any, ...]:
    """The values of a Literal; none of another type."""
    return get_args(kind) if get_origin(kind) is Literal else ()


def _path(kind: type, value: Any) -> Any:
    if kind is Path:
        return Path(value)
    raise TypeError(f"no setting of type {kind} is read from a text")


def suite_keys(options: type[msgspec.Struct]) -> list[tuple[str, Any, None]]:
    """The fields of a table in a suite file: name, type, and the default None for a setting that is left out."""
    keys = []
    for one in declared(options).values():
        kind = one.bounded if one.option.suite is SAME else one.option.suite
        if kind is not None:
            kind = str if one.type == Path | None else kind
            keys.append((one.name, Annotated[kind | None, Meta(description=one.help)], None))
    return keys


def field_texts(struct: type[msgspec.Struct]) -> dict[str, str]:
    """The docstrings below a struct's fields, inherited fields included."""
    texts: dict[str, str] = {}
    for each in reversed(struct.__mro__):
        if issubclass(each, msgspec.Struct) and each is not msgspec.Struct:
            texts |= _texts_in(each.__module__).get(each.__name__, {})
    return texts


@functools.cache
def _texts_in(module: str) -> dict[str, dict[str, str]]:
    """Docstrings below fields, by class and field."""
    return {
        each.name: {
            field.target.id: " ".join(text.value.value.split())
            for field, text in zip(each.body, each.body[1:], strict=False)
            if isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        }
        for each in ast.parse(inspect.getsource(sys.modules[module])).body
        if isinstance(each, ast.ClassDef)
    }
