"""Folders of entries: no two entries share one, and none takes the run of another."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path

import msgspec
import pytest
from rigs.finished_run import SETTINGS, plan_in
from stages.sweep_stage import EVOLVE, HEAD, record_of

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.records.run_record import encode_run_record
from evopolicy_common.records.suite_folder import INDEX, PAUSED
from evopolicy_gateway.run.plan import Plan, check_apart
from evopolicy_gateway.run_folder.layout import run_folder, save
from evopolicy_gateway.suite.suite_file import expand, read_suite

NAMES = (
    *("模型甲", "模型乙", "مثال", "देवनागरी", "café", "Ärger"),
    *("gpt/5", "gpt:5", "gpt_5", "gpt?5", "gpt5", "gpt5.", "gpt5 ", ".gpt5", "gpt5…"),
    *("🚀", "🛸", "_", "a" * 100, "a" * 101, "a" * 300, "模" * 30, "模" * 100, "模" * 99 + "型"),
    *("\udce6", "\udce7", "a\nb", "a\0b", "suite.json", "paused", "Paused"),
)


def name_of(entry: str) -> str:
    return run_folder(Path("/r"), entry, "toy/line", "first").root.parts[2]


def test_different_names_have_different_folders_that_every_system_can_hold() -> None:
    names = {entry: name_of(entry) for entry in NAMES}
    assert len(set(names.values())) == len(NAMES), names
    for entry, name in names.items():
        assert len(name.encode()) <= 120, entry
        assert name == name.strip(" ."), entry
        assert not set(name) & set('/\\:*?"<>|\0\n'), entry
        assert name.casefold() not in (INDEX, PAUSED), entry


@pytest.mark.parametrize("entry", ["模型甲", "देवनागरी", "café", "GPT-5.5 (Codex)", "a" * 100])
def test_letters_and_digits_of_any_script_stay(entry: str) -> None:
    assert name_of(entry) == entry
    assert name_of(unicodedata.normalize("NFD", entry)) == entry


def played(root: Path, **settings: str) -> Plan:
    """The plan of a finished run."""
    plan = plan_in(root, msgspec.structs.replace(SETTINGS, **settings))
    plan.folder.root.mkdir(parents=True)
    plan.folder.run_json.write_bytes(encode_run_record(record_of(plan)))
    return plan


def other(plan: Plan, **settings: str) -> Plan:
    changed = msgspec.structs.replace(plan.settings, **settings)
    return msgspec.structs.replace(plan, settings=changed, overwrite=True)


@pytest.mark.parametrize("how", [{"overwrite": True}, {"resume": True}])
@pytest.mark.parametrize("state", ["finished", "open"])
def test_a_folder_that_a_file_system_shares_keeps_its_run(
    tmp_path: Path, how: dict[str, bool], state: str
) -> None:
    """Names that a file system takes for one, such as `alpha` and `Alpha` on one that ignores case."""
    first = played(tmp_path, entry="Alpha")
    if state == "open":
        first.folder.run_json.unlink()
        first.folder.state.mkdir()
        save(first.folder.intended, CreateRun(key="k", settings=first.settings))
    (tmp_path / "alpha").symlink_to("Alpha")
    second = msgspec.structs.replace(other(first, entry="alpha"), **({"overwrite": False} | how))
    with pytest.raises(ConfigError, match="holds a run of 'Alpha' on 'toy/line', not of 'alpha'"):
        second.claim()
    assert first.folder.run_json.exists() or first.folder.intended.exists()
    msgspec.structs.replace(first, overwrite=True).claim()
    assert not any(first.folder.root.iterdir())


def test_a_folder_that_two_environments_share_keeps_its_run(tmp_path: Path) -> None:
    first = played(tmp_path, env="my_env:Glider-v0")
    with pytest.raises(ConfigError, match="holds a run of 'evolve' on 'my_env:Glider-v0'"):
        other(first, env="my_env/Glider-v0").claim()


@pytest.mark.parametrize("names", [("Alpha", "alpha"), ("café", "cafe\N{COMBINING ACUTE ACCENT}")])
def test_a_plan_refuses_names_that_share_a_folder(tmp_path: Path, names: tuple[str, str]) -> None:
    """On Linux too, whose folders may be copied to a system that ignores case."""
    (tmp_path / "s.toml").write_text(HEAD + "".join(map(EVOLVE.format, names)))
    with pytest.raises(ConfigError, match=rf"{names[0]}.*{names[1]}.*one folder"):
        expand(read_suite(os.fspath(tmp_path / "s.toml")), tmp_path, tmp_path)


def test_a_plan_keeps_names_of_other_scripts_apart(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        HEAD + "".join(map(EVOLVE.format, ("模型甲", "模型乙", "gpt:5", "gpt?5")))
    )
    runs = expand(read_suite(os.fspath(tmp_path / "s.toml")), tmp_path, tmp_path)
    assert len({run.folder.root for run in runs}) == 4
    check_apart(runs)
