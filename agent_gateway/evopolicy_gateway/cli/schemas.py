"""JSON Schemas of the files that people and programs read or write, made from the types that decode these files.

Each schema follows draft 2020-12. Field descriptions are the docstrings that stand below the fields in the source, so
the schema, the code and `docs/reference/files.md` cannot disagree.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.records import suite_folder
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA
from evopolicy_common.records.run_record import RECORD_VERSION, RunRecord
from evopolicy_common.records.summary import Summary
from evopolicy_gateway.declared import field_texts
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.suite.suite_file import SuiteFile

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Kind(NamedTuple):
    """A kind of file."""

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
