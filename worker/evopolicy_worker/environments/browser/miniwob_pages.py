"""The files of the package `miniwob`: pages, their documentation, and the parsing of their instructions.

The files are read from the installed package. The package itself is not imported, since it would import Selenium.
"""

from __future__ import annotations

import ast
import importlib.util
import inspect
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import msgspec

from evopolicy_common.errors import WorkerError

Fields = tuple[tuple[str, str], ...]
"""Parts of an instruction: names and values."""


class PageText(msgspec.Struct, frozen=True):
    """The package's documentation of a page."""

    description: str = ""
    examples: tuple[str, ...] = ()
    """Instructions, as an episode may give them."""
    notes: str = ""


def folder() -> Path | None:
    """Folder of the package; None when it is not installed."""
    spec = find_spec("miniwob")
    places = [] if spec is None else list(spec.submodule_search_locations or ())
    return Path(places[0]) if places else None


def root() -> Path:
    """The folder of its pages. WorkerError when it is not installed."""
    found = folder()
    if found is None:
        raise WorkerError("the package miniwob is not installed")
    return found / "html"


def document(name: str) -> str:
    """Path of a page's document below `root`, by its name: `click-test`, `flight.AA`."""
    return f"{name.replace('.', '/')}/wrapper.html" if name.startswith("flight.") else f"miniwob/{name}.html"


@cache
def texts() -> dict[str, PageText]:
    """The documentation by page name."""
    found: dict[str, PageText] = {}
    place = folder()
    for path in sorted(place.glob("envs/*.py")) if place is not None else []:
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.ClassDef) and (name := _subdomain(node)):
                found[name] = _text(inspect.cleandoc(ast.get_docstring(node) or ""))
    return found


def _subdomain(node: ast.ClassDef) -> str:
    for each in node.body:
        if (
            isinstance(each, ast.Assign)
            and isinstance(each.targets[0], ast.Name)
            and each.targets[0].id == "subdomain"
            and isinstance(each.value, ast.Constant)
        ):
            return str(each.value.value)
    return ""


def _text(doc: str) -> PageText:
    parts: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in doc.splitlines():
        if line.startswith("## "):
            lines = parts.setdefault(line[3:].strip().lower(), [])
        else:
            lines.append(line)
    examples = (
        line.strip()[2:] for line in parts.get("example utterances", ()) if line.strip().startswith("* ")
    )
    return PageText(
        "\n".join(parts.get("description", ())).strip(),
        tuple(each for each in examples if each != "TODO"),
        "\n".join(line for line in parts.get("additional notes", ()) if "preprocessor" not in line).strip(),
    )


@cache
def _extractors() -> dict[str, Callable[[str], Sequence[tuple[str, str]]]]:
    place = folder()
    if place is None or not (place / "fields.py").is_file():
        return {}
    spec = importlib.util.spec_from_file_location("evopolicy_miniwob_fields", place / "fields.py")
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
