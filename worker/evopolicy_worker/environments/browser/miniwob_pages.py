"""The files of the package `miniwob`: pages, their documentation, and the parsing of their instructions.

The files are read from the installed package. The package itself is not imported, since it would import Selenium.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import msgspec

from evopolicy_common.errors import WorkerError

Fields = tuple[tuple[str, str], ...]
"""Parts of an instruction: names and values."""


class PageText(msgspec.Struct, frozen=True):
    description: str = ""
    examples: tuple[str, ...] = ()
    """Instructions, as an episode may give them."""
    notes: str = ""


def folder() -> Path:
    """Folder of the package. WorkerError when it is not installed."""
    spec = find_spec("miniwob")
    if spec is None or not spec.submodule_search_locations:
        raise WorkerError("the package miniwob is not installed")
    return Path(spec.submodule_search_locations[0])


def document(name: str) -> str:
    """Path of a page's document below the folder `html`, by its name: `click-test`, `flight.AA`."""
    return f"{name.replace('.', '/')}/wrapper.html" if name.startswith("flight.") else f"miniwob/{name}.html"


@cache
def texts() -> dict[str, PageText]:
    """The documentation by page name."""
    nodes = (
        node
        for path in sorted(folder().glob("envs/*.py"))
        for node in ast.parse(path.read_text("utf-8")).body
        if isinstance(node, ast.ClassDef)
    )
    return {name: _text(ast.get_docstring(node) or "") for node in nodes if (name := _subdomain(node))}


def _subdomain(node: ast.ClassDef) -> str:
    for each in node.body:
        if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "subdomain":
            return str(ast.literal_eval(each.value))
    return ""


def _text(doc: str) -> PageText:
    sections = re.findall(r"^## *(.*?) *\n(.*?)(?=^## |\Z)", doc, re.MULTILINE | re.DOTALL)
    parts = {name.lower(): text for name, text in sections}
    lines = [line.strip() for line in parts.get("example utterances", "").splitlines()]
    examples = (line[2:] for line in lines if line.startswith("* "))
    notes = parts.get("additional notes", "").splitlines()
    return PageText(
        parts.get("description", "").strip(),
        tuple(each for each in examples if each != "TODO"),
        "\n".join(line for line in notes if "preprocessor" not in line).strip(),
    )


@cache
def _extractors() -> dict[str, Callable[[str], Sequence[tuple[str, str]]]]:
    place = folder() / "fields.py"
    if not place.is_file():
        return {}
    spec = importlib.util.spec_from_file_location("evopolicy_miniwob_fields", place)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return dict(module.FIELD_EXTRACTORS)


def fields(name: str, utterance: str) -> Fields:
    """The parts of an instruction; none where the package does not tell how to find them."""
    extract = _extractors().get(name)
    if extract is None:
        return ()
    try:
        return tuple((str(key), str(value)) for key, value in extract(utterance))
    except (ValueError, KeyError, IndexError, AttributeError):
        return ()
