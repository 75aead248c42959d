"""Writes `docs/reference/files.md` from the files' types: `python docs/_site/files.py > docs/reference/files.md`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from evopolicy_gateway.cli import files
from evopolicy_gateway.declared import declared
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.run_options import RunOptions
from evopolicy_gateway.suite.suite_file import Override, RunTable

HEAD = """# Files, field by field

`evopolicy files schemas/NAME.schema.json` prints the JSON Schema of each of these files, and of `suite.json`.
Fields without a type are texts, and `[]` marks an array. A question mark follows a field that may be absent; its
default is bold, or follows the type, unless it is empty, zero, false, or null. *Also* names fields without a
description; the schemas have their types.

An editor checks a suite file that begins with `#:schema ./suite.schema.json`, where
`evopolicy files schemas/suite.toml.schema.json > suite.schema.json` wrote that file.
"""
OF_A_RUN = {*declared(RunOptions), *declared(JailSettings)}
"""Settings that `options.md` describes."""
PLAIN = {f"{kind}{null}" for kind in ("string", "integer", "number", "boolean") for null in ("", " or null")}
"""Types of fields that need no line of their own without a description."""


def page() -> Iterator[str]:
    """The page's parts. A type is described where it first occurs."""
    yield HEAD
    done: set[type[msgspec.Struct]] = set()
    for name in ("suite.toml", "agent.toml", "run.json", "summary.json"):
        kind, described = files.KINDS[name], files.schema(name)["$defs"]
        yield f"## {name}\n\n{kind.about} Version {kind.version}.\n"
        later = kind.type in done
        if later:
            yield f"[{kind.type.__name__}](#{kind.type.__name__.lower()}) lists its fields.\n"
        for struct in files.structs(kind.type):
            if struct not in done:
                done.add(struct)
                yield from _struct(struct, described[struct.__name__], first=struct is kind.type)


def _struct(struct: type[msgspec.Struct], described: dict[str, Any], *, first: bool) -> Iterator[str]:
    if not first:
        yield f"### {struct.__name__}\n\n{described.get('description', '')}\n"
    fields, needed = dict(described["properties"]), described.get("required", ())
    if struct is Override:
        yield "It takes the keys of [RunTable](#runtable), and:\n"
        fields = {name: one for name, one in fields.items() if name not in RunTable.__struct_fields__}
    named = [f"`{name}`" for name in fields if struct in (RunTable, JailSettings) and name in OF_A_RUN]
    if named:
        rest = ", except for:" if len(named) < len(fields) else "."
        yield f"[Options of a run](options.md) describes its fields{rest}\n"
    bare = [name for name, one in fields.items() if "description" not in one and _type_text(one) in PLAIN]
    for name, one in fields.items():
        if f"`{name}`" not in named and name not in bare:
            default = None if name in needed else one.get("default")
            text = f": {one['description']}" if "description" in one else ""
            kind = _type_text(one).removesuffix(" or null")
            if isinstance(default, str) and f"`{default}`" in kind:
                kind = kind.replace(f"`{default}`", f"**`{default}`**")
            elif default and len(value := msgspec.json.encode(default).decode()) < 40:
                kind += f", `{value}`"
            kind = "" if kind == "string" else f" ({kind})"
            yield _line(f"- `{name}`{'' if name in needed else '?'}{kind}{text}")
    if bare:
        yield f"- Also {', '.join(f'`{name}`' + '?' * (name not in needed) for name in bare)}."
    yield ""


def _line(text: str) -> str:
    return text.replace("<", "&lt;").replace(">", "&gt;")


def _type_text(described: dict[str, Any]) -> str:
    """A schema's type in words, such as `string or null`."""
    if "$ref" in described:
        return str(described["$ref"].rpartition("/")[2])
    if "anyOf" in described:
        return " or ".join(_type_text(each) for each in described["anyOf"])
    if "enum" in described:
        return ", ".join(f"`{each}`" for each in described["enum"])
    if described.get("type") == "array":
        items: dict[str, Any] = described.get("items") or next(iter(described.get("prefixItems", ())), {})
        kind = _type_text(items)
        return f"({kind})[]" if " or " in kind else f"{kind}[]" if items else "array"
    if described.get("type") == "object" and isinstance(described.get("additionalProperties"), dict):
        return f"object of {_type_text(described['additionalProperties']) or 'any'}"
    return str(described.get("type", "any"))


if __name__ == "__main__":
    print("\n".join(page()))
