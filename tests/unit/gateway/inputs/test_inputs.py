"""Skills and MCP servers as inputs: read without following links, digested, copied for the run, and compared at each
start."""

from __future__ import annotations

import json
import os
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from stages.declared_inputs import DESCRIPTION, declare
from stages.provider_api import conversation_settings

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.run_record import inputs_digest
from evopolicy_gateway.harnesses import make
from evopolicy_gateway.harnesses.coding_agents.cli_agent import CliAgent
from evopolicy_gateway.harnesses.interface.agent_config import AcpTable, AgentConfig, Cli
from evopolicy_gateway.inputs import declared
from evopolicy_gateway.inputs.declared import McpServer, read_inputs
from evopolicy_gateway.inputs.kept import MCP_FILE, KeptInputs, keep
from evopolicy_gateway.run import plan


def kept(folder: Path, place: Path) -> KeptInputs:
    skills, servers = declare(folder)
    expected = [each.recorded for each in read_inputs(skills, servers, folder)]
    return keep(skills, servers, folder, place, expected)


def test_a_digest_depends_on_content_and_not_on_the_place(tmp_path: Path) -> None:
    contents = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        skills, servers = declare(tmp_path / name)
        contents.append([each.recorded for each in read_inputs(skills, servers, tmp_path / name)])
    assert contents[0] == contents[1]
    assert [(each.kind, each.name, each.hosts) for each in contents[0]] == [
        ("skill", "lamps", ()),
        ("mcp", "lamp", ("lamps.example.org",)),
    ]
    assert inputs_digest(contents[0]) == inputs_digest(contents[0][::-1]) != inputs_digest(contents[0][:1])


@pytest.mark.parametrize(
    ("place", "which"),
    [("skills/lamps/scripts/read.sh", 0), ("tools/lamp.txt", 1), ("tools/mcp_server.py", 1)],
)
def test_every_byte_and_right_of_a_file_counts(tmp_path: Path, place: str, which: int) -> None:
    skills, servers = declare(tmp_path)
    digests = []
    for change in (lambda path: None, lambda path: path.write_text("x"), lambda path: path.chmod(0o700)):
        change(tmp_path / place)
        digests.append([each.recorded.digest for each in read_inputs(skills, servers, tmp_path)])
    assert len({each[which] for each in digests}) == (2 if place.endswith(".sh") else 3)
    assert len({each[1 - which] for each in digests}) == 1


def test_a_servers_command_line_and_variables_belong_to_its_digest(tmp_path: Path) -> None:
    _, servers = declare(tmp_path)
    first = servers["lamp"]
    others = [
        first,
        msgspec.structs.replace(first, args=(*first.args, "--bright")),
        msgspec.structs.replace(first, environment={"UNIT": "candela"}),
        msgspec.structs.replace(first, command="sh"),
    ]
    assert len({read_inputs((), {"lamp": each}, tmp_path)[0].recorded.digest for each in others}) == 4


FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a link to a file": (lambda skill: (skill / "key").symlink_to("/etc/hostname"), "is a symbolic link"),
    "a link to a folder": (lambda skill: (skill / "more").symlink_to("/etc"), "is a symbolic link"),
    "a pipe": (lambda skill: os.mkfifo(skill / "pipe"), "is no regular file"),
    "no SKILL.md": (lambda skill: (skill / "SKILL.md").unlink(), "has no SKILL.md"),
    "too large": (lambda skill: (skill / "big").write_bytes(bytes(declared.MAX_BYTES)), "more than 16 MiB"),
    "gone": (shutil.rmtree, "does not exist"),
    "a link in its place": (
        lambda skill: (skill.rename(skill.with_name("real")), skill.symlink_to("real")),
        "is a symbolic link",
    ),
    "a link on the way": (
        lambda skill: (skill.parent.rename(skill.parents[1] / "real"), skill.parent.symlink_to("real")),
        "is a symbolic link",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_skill_that_is_not_what_it_seems_is_refused(tmp_path: Path, fault: str) -> None:
    skills, _ = declare(tmp_path)
    change, message = FAULTS[fault]
    change(tmp_path / "skills" / "lamps")
    with pytest.raises(ConfigError, match=message):
        read_inputs(skills, {}, tmp_path)


@pytest.mark.parametrize("path", ["../outside", "/etc", "skills/../../outside", "."])
def test_a_skill_outside_the_folder_of_the_command_is_refused(tmp_path: Path, path: str) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "SKILL.md").touch()
    (tmp_path / "mine").mkdir()
    with pytest.raises(ConfigError, match="is not below"):
        read_inputs([path], {}, tmp_path / "mine")


def test_odd_servers_are_refused_with_the_entry(tmp_path: Path) -> None:
    (tmp_path / "outside.py").touch()
    (tmp_path / "mine" / "other").mkdir(parents=True)
    for name in ("server.py", "other/server.py"):
        (tmp_path / "mine" / name).touch()
    for server, message in (
        (McpServer(command="no-such-program"), r"mcp\.lamp\.command: there is no program"),
        (McpServer(command="sh", args=("../outside.py",)), r"mcp\.lamp\.args: .* is not below"),
        (McpServer(command="sh", files=("nothing",)), "does not exist"),
        (McpServer(command="sh", args=("server.py", "other/server.py")), "are named 'server.py'"),
        (McpServer(command="sh", hosts=("*.example.org",)), r"mcp\.lamp\.hosts"),
    ):
        with pytest.raises(ConfigError, match=message):
            read_inputs((), {"lamp": server}, tmp_path / "mine")
    with pytest.raises(ConfigError, match="the name"):
        read_inputs((), {"the lamp": McpServer(command="sh")}, tmp_path)


def test_a_runs_own_copies_outlive_their_source(tmp_path: Path) -> None:
    copies = kept(tmp_path, tmp_path / "run")
    shown = dict(copies.shown("~/.agents/skills"))
    assert sorted(shown.values()) == ["/inputs/mcp.json", "/inputs/mcp/lamp", "~/.agents/skills/lamps"]
    script = tmp_path / "run" / "skills" / "lamps" / "scripts" / "read.sh"
    assert (script.stat().st_mode & 0o777) == 0o555
    server = json.loads((tmp_path / "run" / "mcp.json").read_text())["mcpServers"]["lamp"]
    assert server["args"] == ["/inputs/mcp/lamp/tools/mcp_server.py"]
    assert server["env"] == {"UNIT": "lux"}


def test_inputs_that_change_while_a_run_is_open_are_refused_by_name(tmp_path: Path) -> None:
    place = tmp_path / "run"
    skills, servers = declare(tmp_path)
    expected = [each.recorded for each in read_inputs(skills, servers, tmp_path)]
    keep(skills, servers, tmp_path, place, expected)
    copy = place / "skills" / "lamps" / "SKILL.md"
    copy.chmod(0o600)
    copy.write_text("Answer 43.")
    with pytest.raises(ConfigError, match=r"copy of skill lamps .* was changed"):
        keep(skills, servers, tmp_path, place, expected)
    shutil.rmtree(place)
    keep(skills, servers, tmp_path, place, expected)
    (place / "mcp" / "lamp" / "extra.py").symlink_to("/etc/hostname")
    with pytest.raises(ConfigError, match=r"copy of mcp lamp .* was changed"):
        keep(skills, servers, tmp_path, place, expected)
    (tmp_path / "tools" / "lamp.txt").write_text("43")
    with pytest.raises(ConfigError, match="mcp lamp in the agent's file changed after the run was opened"):
        keep(skills, servers, tmp_path, place, expected)


def test_the_digest_is_a_setting_of_the_run(tmp_path: Path) -> None:
    skills, servers = declare(tmp_path)
    config = AgentConfig(harness="codex", skills=skills, mcp=servers)
    given = plan.read_texts(None, None, config, tmp_path)
    assert given.digests["inputs"] == inputs_digest(given.inputs)
    assert len(given.digests["inputs"]) == 64
    assert plan.read_texts(None, None, AgentConfig(harness="codex"), tmp_path).digests["inputs"] == ""


def words_of(folder: Path, config: AgentConfig, options: str = "") -> list[str]:
    folder.mkdir()
    harness = make(config.harness, folder, config)
    assert isinstance(harness, CliAgent)
    harness.take_inputs(kept(folder, folder / "run"))
    return harness._dialect.arguments("s-1", resume=False, prompt="", options=options)


def test_each_cli_is_told_in_its_own_form(tmp_path: Path) -> None:
    options = "--tools --safe-mode --strict-mcp-config --setting-sources --mcp-config"
    words = words_of(tmp_path / "claude", AgentConfig(harness="claude-code"), options)
    assert words[words.index("--mcp-config") + 1] == MCP_FILE
    assert words[words.index("--tools") + 1].endswith(",Skill")
    assert "--strict-mcp-config" in words
    assert "--safe-mode" not in words
    words = words_of(tmp_path / "codex", AgentConfig(harness="codex"))
    assert 'mcp_servers.lamp.args=["/inputs/mcp/lamp/tools/mcp_server.py"]' in words
    assert 'mcp_servers.lamp.env={"UNIT" = "lux"}' in words
    cli = Cli(first=("--go",), mcp=("--mcp-config", "{mcp_config}"))
    words = words_of(tmp_path / "own", AgentConfig(harness="own", program=("true",), cli=cli))
    assert words == ["--go", "--mcp-config", MCP_FILE]


def test_codex_is_told_in_toml_whatever_the_characters(tmp_path: Path) -> None:
    odd = ("\U0001f642", "\x7f\x01\n", '"\\')
    server = McpServer(command="sh", args=odd, environment={"MY VALUE": odd[0], "DOTTED.NAME": odd[1]})
    config = AgentConfig(harness="codex", mcp={"lamp": server})
    expected = [each.recorded for each in read_inputs((), config.mcp, tmp_path)]
    harness = make("codex", tmp_path, config)
    harness.take_inputs(keep((), config.mcp, tmp_path, tmp_path / "run", expected))
    assert isinstance(harness, CliAgent)
    words = harness._dialect.arguments(None, resume=False, prompt="", options="")
    document = tomllib.loads("\n".join(word for word in words if word.startswith("mcp_servers.lamp.")))
    lamp = document["mcp_servers"]["lamp"]
    assert lamp["args"] == list(odd)
    assert lamp["env"] == dict(server.environment)


def test_a_name_that_is_not_utf8_is_refused_with_the_remedy(tmp_path: Path) -> None:
    declare(tmp_path)
    Path(os.fsdecode(os.fsencode(tmp_path / "skills" / "lamps") + b"/\xff")).touch()
    with pytest.raises(ConfigError, match="is not UTF-8; rename the file"):
        read_inputs(("skills/lamps",), {}, tmp_path)


def test_agents_that_cannot_be_told_of_servers_are_refused(tmp_path: Path) -> None:
    servers = {"lamp": McpServer(command="sh")}
    config = AgentConfig(harness="own", program=("true",), cli=Cli(first=("--go",)), mcp=servers)
    with pytest.raises(ConfigError, match=r"cli\.mcp"):
        make("own", tmp_path, config)


@pytest.mark.parametrize(
    ("program", "place"),
    [("claude-agent-acp", "~/.claude/skills"), ("qwen", "~/.qwen/skills"), ("other", "~/.agents/skills")],
)
def test_skills_are_where_the_agent_looks_for_them(tmp_path: Path, program: str, place: str) -> None:
    pytest.importorskip("acp")
    config = AgentConfig(harness="mine", program=(program,), acp=AcpTable())
    assert make("mine", tmp_path, config).skills_at == place
    own = msgspec.structs.replace(config, skills_at="~/.mine/skills")
    assert make("mine", tmp_path, own).skills_at == "~/.mine/skills"


def test_the_built_in_agent_tells_its_model_when_to_read_a_skill(tmp_path: Path) -> None:
    Conversation = pytest.importorskip("evopolicy_gateway.agents.llm.conversation").Conversation  # noqa: N806
    declare(tmp_path)
    path = str(tmp_path / "skills/lamps/SKILL.md")
    settings = conversation_settings("", "responses", provider="openai", skills=[path])
    system = Conversation(settings, "key")._system
    assert path in system
    assert DESCRIPTION in system
    assert "Read the lamp twice" not in system
