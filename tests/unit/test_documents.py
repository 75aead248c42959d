"""What the documents name is there: files, links, commands and their options, make's targets."""

from __future__ import annotations

import ast
import re
import runpy
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import msgspec
import pytest
import typer
from documents import APPS, blocks_of_commands, commands, parse
from program_runs import run_program

from evopolicy_common import catalogue
from evopolicy_coordinator.server.request_parser import REQUESTS

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *(f"{name}.md" for name in ("README", "ARCHITECTURE", "SECURITY", "CONTRIBUTING", "THIRD_PARTY")),
    *("deploy/README.md", "examples/policies/README.md"),
    *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md"))),
]
FOLDERS = ("common", "coordinator", "worker", "agent_gateway", "deploy", "docs", "examples", "tests")
ELSEWHERE = frozenset(
    {"AGENTS.md", "system/policy.py", "policy.py", "my_policy/policy.py", "my_agent.py", "my_env.py"}
)
"""Files of a workspace, of an agent's or of an operator's."""
ROOMS = {
    "common/": "common/evopolicy_common/",
    "coordinator/": "coordinator/evopolicy_coordinator/",
    "worker/": "worker/evopolicy_worker/",
    "gateway/": "agent_gateway/evopolicy_gateway/",
}
"""How tables shorten a room's package."""


def text_of(document: str) -> str:
    return (ROOT / document).read_text()


def code_in(document: str) -> list[str]:
    """The texts in backticks within a line."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text_of(document), flags=re.DOTALL))


@cache
def tree() -> frozenset[str]:
    """Paths of all files and folders that belong to the project."""
    words = ("git", "ls-files", "--cached", "--others", "--exclude-standard")
    names = run_program(*words, cwd=ROOT).stdout.splitlines()
    # Unpacked from an archive there is no git to ask.
    files = names or [
        str(path.relative_to(ROOT)) for folder in FOLDERS for path in (ROOT / folder).rglob("*")
    ]
    return frozenset(str(each) for name in files for each in (Path(name), *Path(name).parents))


@cache
def text_of_tests() -> str:
    return "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))


def is_there(name: str) -> bool:
    """A path in the tree, from its root, a room's package, or as the only end of a path that says so."""
    name = name.rstrip("/")
    for short, whole in ROOMS.items():
        if name.startswith(short) and whole + name.removeprefix(short) in tree():
            return True
    return name in tree() or any(path.endswith(f"/{name}") for path in tree())


@pytest.mark.parametrize("document", DOCUMENTS)
def test_files_that_a_document_names_are_there(document: str) -> None:
    named = {word.partition("::")[0] for word in code_in(document) if " " not in word and "{" not in word}
    files = {
        word
        for word in named
        if re.fullmatch(r"[\w@./-]+\.(py|md|toml|yaml|sh)", word) or word.partition("/")[0] in FOLDERS
    }
    assert {word for word in files - ELSEWHERE if not is_there(word)} == set()


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_of_a_document_lead_somewhere(document: str) -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)", text_of(document)) if "://" not in link]
    assert [link for link in links if not (ROOT / document).parent.joinpath(link).exists()] == []


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_in_a_documents_blocks_are_taken(document: str) -> None:
    for block in blocks_of_commands(ROOT / document):
        for words in block:
            parse(words)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_options_that_a_document_names_are_ours(document: str) -> None:
    every = [*(command for _, command in commands()), *map(typer.main.get_command, APPS.values())]
    ours = {option for command in every for each in command.params for option in each.opts}
    code = [
        word for word in code_in(document) if " pytest " not in word and not word.startswith("systemd-run")
    ]
    named = {option for word in code for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", word)}
    # Of a bench, or of the tests.
    ways = {option: (f'"{option}"', f"        {option[2:].replace('-', '_')}=(") for option in named - ours}
    tests = text_of_tests()
    assert [option for option, way in ways.items() if not any(each in tests for each in way)] == []


def test_make_has_the_targets_that_documents_name() -> None:
    targets = set(re.findall(r"^([a-z-]+):", text_of("Makefile"), re.MULTILINE))
    for document in DOCUMENTS:
        assert set(re.findall(r"`make ([a-z-]+)", text_of(document))) <= targets, document


@pytest.mark.parametrize("walk", ["One submit", "One hidden evaluation", "One report"])
def test_a_walk_of_the_architecture_leads_through_at_most_25_files(walk: str) -> None:
    text = text_of("ARCHITECTURE.md").partition(f"\n## {walk}\n")[2].partition("\n## ")[0]
    assert 0 < len(set(re.findall(r"\]\(([^)]+)\)", text))) <= 25


def test_the_keys_that_the_architecture_lists_are_those_that_are_answered() -> None:
    listed = re.findall(r"`(?:work|gw/<run>)/\{([^}]+)\}`", text_of("ARCHITECTURE.md"))
    assert len(listed) == 2
    verbs = {verb.strip() for verbs in listed for verb in verbs.split(",")}
    assert verbs == {row.verb for row in REQUESTS.values() if row.verb}


def test_the_table_of_families_is_the_catalogue_s() -> None:
    families = runpy.run_path(str(ROOT / "docs" / "_site" / "families.py"))
    for path in families["DOCUMENTS"]:
        assert path.read_text("utf-8") == families["written"](path.read_text("utf-8")), (
            "python docs/_site/families.py"
        )


def test_the_table_of_floors_and_ceilings_is_the_catalogue_s() -> None:
    anchors = runpy.run_path(str(ROOT / "docs" / "_site" / "anchors.py"))
    page = anchors["PAGE"].read_text("utf-8")
    assert page == anchors["written"](page), "python docs/_site/anchors.py"
    assert set(msgspec.json.decode(anchors["FILE"].read_bytes())) == set(catalogue.anchors())


def test_a_family_is_in_the_files_that_contributors_are_told() -> None:
    section = (
        text_of("CONTRIBUTING.md").partition("## Add a family of environments\n")[2].partition("\n## ")[0]
    )
    words = re.findall("`([^` ]+)`", section)
    told = {word.format(family="crafter", env="crafter_CrafterReward-v1") for word in words}
    apart = ("CHANGELOG.md", "CONTRIBUTING.md", "tests/unit/", "tests/conformance/")
    files = {path for path in tree() if (ROOT / path).is_file() and not path.startswith(apart)}
    assert {
        each for each in files if b"crafter" in each.encode() + (ROOT / each).read_bytes()
    } == told & files


def test_rows_of_played_environments_stay_when_others_are_played(tmp_path: Path) -> None:
    pages = runpy.run_path(str(ROOT / "docs" / "_site" / "environments.py"))
    (tmp_path / "none.jsonl").touch()
    rows, suites = pages["earlier"](), pages["shown"]()
    for suite in suites:
        page = (pages["FOLDER"] / f"{suite.name}.md").read_text()
        assert pages["written"](suite, tmp_path / "none.jsonl", rows) == page, "make check-envs"
    assert {f"{suite.name}.md" for suite in suites} == {path.name for path in pages["FOLDER"].iterdir()}
    shown = set(re.findall(r"^\| `(\S+)` \|", rows, re.MULTILINE))
    assert shown == {env_id for env_id, row in catalogue.entries().items() if not row.world}


def texts_in_code() -> Iterator[str]:
    """Every text in the product's code, with `…` for values; texts that are written one after another are one."""
    for room in ROOMS.values():
        for path in (ROOT / room).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value
                elif isinstance(node, ast.JoinedStr):
                    yield "".join(
                        str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values
                    )


def test_messages_on_the_page_about_trouble_are_in_the_code() -> None:
    page = text_of("docs/how-to/troubleshooting.md")
    messages = set(re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE))
    assert len(messages) > 20
    code = "\n".join(texts_in_code())
    assert {message for message in messages if message not in code} == set()
    assert "no message of ours says this" not in code


@pytest.mark.parametrize(
    ("script", "page"), [("commands", "cli"), ("options", "options"), ("files", "files")]
)
def test_generated_pages_are_those_of_the_code(script: str, page: str) -> None:
    written = run_program(sys.executable, ROOT / f"docs/_site/{script}.py").stdout
    command = f"python docs/_site/{script}.py > docs/reference/{page}.md"
    assert text_of(f"docs/reference/{page}.md") == written, command


def test_the_runs_of_the_readme_fit_into_one_report() -> None:
    """`make demo` and the runs below it stand in one folder, and a report takes runs of one budget on one suite."""
    source = (ROOT / "agent_gateway/evopolicy_gateway/cli/play.py").read_text()
    (demo,) = re.findall(r"agent=\"evolve\", budget=(\d+)", source)
    assert set(re.findall(r"--budget (\d+)", text_of("README.md"))) == {demo}
