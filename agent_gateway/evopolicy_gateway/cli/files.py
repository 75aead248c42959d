"""`evopolicy files`: the files that come with the package besides code, and those that it can write.

JSON Schemas are made from the types that decode the files, by draft 2020-12. Field descriptions are the docstrings
that stand below the fields in the source, so the schema, the code and `docs/reference/files.md` cannot disagree.
"""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError
from evopolicy_common.records import suite_folder
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA
from evopolicy_common.records.run_record import RECORD_VERSION, RunRecord
from evopolicy_common.records.summary import Summary
from evopolicy_common.terminal import say_json, say_lines
from evopolicy_gateway import shipped
from evopolicy_gateway.declared import field_texts
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.suite.suite_file import SuiteFile
from evopolicy_gateway.workspace import agents_md, prompts

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Kind(NamedTuple):
    type: type[msgspec.Struct]
    version: str
    """Changes when files of this kind change incompatibly."""
    about: str


KINDS = {
    "run.json": Kind(
        RunRecord,
        f"{PUBLISHED_SCHEMA}+{RECORD_VERSION}",
        "The record of a finished run, in its run directory.",
    ),
    "summary.json": Kind(
        Summary,
        PUBLISHED_SCHEMA,
        "The result of one submit, in its feedback folder; also the reply to the submit.",
    ),
    "suite.json": Kind(
        suite_folder.Index,
        str(suite_folder.SCHEMA_VERSION),
        "The state of each run of a sweep, in the sweep's folder.",
    ),
    "suite.toml": Kind(SuiteFile, "1", "A sweep, as `evopolicy suite` reads it."),
    "agent.toml": Kind(
        AgentConfig, "1", "A coding agent, as `--agent` and a suite's `[agents.config]` read it."
    ),
}


def schema(name: str) -> dict[str, Any]:
    """The JSON Schema of a kind of file, by the file's name. Raises ConfigError for an unknown name."""
    kind = KINDS.get(name)
    if kind is None:
        raise ConfigError(f"no schema {name!r}; there are {', '.join(KINDS)}")
    (root,), components = msgspec.json.schema_components([kind.type], ref_template="#/$defs/{name}")
    for each in structs(kind.type):
        if about := components[each.__name__].get("description"):
            # Python takes a docstring's indentation away only since 3.13.
            components[each.__name__]["description"] = inspect.cleandoc(about)
        properties, texts = components[each.__name__]["properties"], field_texts(each)
        for field in properties.keys() & texts.keys():
            properties[field]["description"] = texts[field]
    return {
        "$schema": DIALECT,
        "$id": f"urn:evopolicy:schema:{name}:{kind.version}",
        "title": name,
        "description": kind.about,
        **root,
        "$defs": components,
    }


def structs(root: type[msgspec.Struct]) -> list[type[msgspec.Struct]]:
    """The struct types that a type holds, itself first, in the order of its fields."""
    structs: dict[type[msgspec.Struct], None] = {}
    open_types: list[Any] = [msgspec.inspect.type_info(root)]
    while open_types:
        each = open_types.pop()
        inner: Any = each if isinstance(each, tuple) else ()
        if isinstance(each, msgspec.inspect.StructType):
            inner = [field.type for field in each.fields if each.cls not in structs]
            structs[each.cls] = None
        elif isinstance(each, msgspec.inspect.Type):
            inner = msgspec.structs.astuple(each)
        open_types += reversed(inner)
    return list(structs)


app = App()


@app.command("files", epilog="Example: evopolicy files deploy --to .")
def files(
    name: Annotated[str, typer.Argument(help="File or folder, such as deploy; default: all.")] = "",
    to: Annotated[Path | None, typer.Option(help="Copy the files into this folder.")] = None,
) -> None:
    """List, print or copy the files that come with evopolicy: examples, deployment files, standard texts, schemas,
    pages.

    Commands find these files by name, unless the current folder has a file of that name.
    """
    with fail_on_our_errors():
        wanted = name.rstrip("/")
        if wanted in (made := _made()) and to is None:
            if wanted.startswith("schemas/"):
                say_json(msgspec.json.decode(made[wanted]()))
            else:
                say_lines(made[wanted]().splitlines())
            return
        everything: list[tuple[str, Path | Callable[[], str]]] = [*shipped.files(), *made.items()]
        chosen = [
            (each, place)
            for each, place in everything
            if not wanted or each == wanted or each.startswith(f"{wanted}/")
        ]
        if not chosen:
            raise ConfigError(f"no file {name!r} comes with evopolicy; `evopolicy files` lists all")
        if to is None:
            # One file is given as its place, for other programs: pip install -c "$(evopolicy files constraints.txt)".
            say_lines([str(chosen[0][1])] if chosen[0][0] == wanted else [each for each, _ in chosen])
            return
        targets = [to / each for each, _ in chosen]
        there = [target for target in targets if target.exists()]
        if there:
            raise ConfigError(f"{there[0]} already exists; choose another folder with --to")
        for target, (_, place) in zip(targets, chosen, strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(place, Path):
                shutil.copyfile(place, target)
            else:
                target.write_text(place(), encoding="utf-8")
        say_lines([f"{len(chosen)} files copied to {to}"])


def _made() -> dict[str, Callable[[], str]]:
    """The files that are written on demand, by name."""
    texts: dict[str, Callable[[], str]] = {
        "texts/agents.md": lambda: agents_md.STANDARD,
        "texts/prompts.toml": lambda: (
            "\n".join(f'{name} = """\\\n{text}"""' for name, text in prompts.STANDARD.items()) + "\n"
        ),
    }
    return texts | {f"schemas/{name}.schema.json": partial(_schema, name) for name in KINDS}


def _schema(name: str) -> str:
    return msgspec.json.format(msgspec.json.encode(schema(name)), indent=2).decode() + "\n"
