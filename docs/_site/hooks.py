"""Builds the site from `docs/` and from the documents in the repository's root, which readers expect there."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT_PAGES = {
    "ARCHITECTURE.md": "explanation/architecture.md",
    "SECURITY.md": "explanation/security.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "THIRD_PARTY.md": "reference/third-party.md",
    "deploy/README.md": "how-to/deploy.md",
    "examples/policies/README.md": "reference/example-policies.md",
}
"""Where a document of the repository stands in the site."""
FILES = {"examples/notebooks/tutorial.ipynb": "notebooks/tutorial.ipynb"}
"""Where a file that is no page stands in the site."""
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Adds the families' pages, which have the names of suites, by their titles."""
    pages = {}
    for path in Path(config["docs_dir"], "reference", "environments").glob("*.md"):
        title = path.read_text("utf-8").partition("\n")[0].removeprefix("# ")
        pages[title] = f"reference/environments/{path.name}"
    families = [{title: pages[title]} for title in sorted(pages, key=str.casefold)]
    next(each["Environments"] for each in config["nav"] if "Environments" in each).append(
        {"Families": families}
    )
    return config


def on_files(files: Files, config: Any) -> Files:
    """Adds the root's documents under their place in the site."""
    root = posixpath.dirname(config["docs_dir"])
    for source, page in ROOT_PAGES.items():
        with open(posixpath.join(root, source), encoding="utf-8") as text:
            files.append(File.generated(config, page, content=text.read()))
    for source, place in FILES.items():
        files.append(File.generated(config, place, abs_src_path=posixpath.join(root, source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Leads links between root and `docs/` to the site's pages; a file that is no page keeps its name only."""
    sources = {place: source for source, place in ROOT_PAGES.items()}
    place = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def led(match: re.Match[str]) -> str:
        picture, label, target, anchor = match.groups()
        if "://" in target:
            return match.group(0)
        source = posixpath.normpath(posixpath.join(posixpath.dirname(place), target))
        inside = source.removeprefix("docs/") if source.startswith("docs/") else ""
        uri = (ROOT_PAGES | FILES).get(source) or inside
        if not uri and posixpath.exists(posixpath.join(posixpath.dirname(config["docs_dir"]), source)):
            return label
        if not uri or files.get_file_from_path(uri) is None:
            return match.group(0)
        return f"{picture}[{label}]({posixpath.relpath(uri, posixpath.dirname(page.file.src_uri) or '.')}{anchor or ''})"  # noqa: E501

    return LINK.sub(led, markdown)
