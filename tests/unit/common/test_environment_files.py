"""Environment files: what they define, and what is wrong with them in words that name file, environment and field."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from evopolicy_common import catalogue
from evopolicy_common.catalogue.definition import read_file
from evopolicy_common.errors import ConfigError

GOOD = """
id = "acme/glider"
gymnasium_id = "acme_envs:Glider-v0"
title = "Glider"
family = "acme"
max_episode_steps = 15
task_file = "glider.md"
success = "near"
success_at = "any"
reward_components = {near = "1 near the origin"}

[kwargs]
push = 0.3

[[wrappers]]
wrapper = "ClipAction"
"""


def test_a_file_defines_an_environment_with_all_that_is_stated_of_it(tmp_path: Path) -> None:
    (tmp_path / "glider.toml").write_text(GOOD)
    (tmp_path / "glider.md").write_text("# Glide")
    (entry,) = read_file(tmp_path / "glider.toml")
    assert (entry.id, entry.gymnasium_id, entry.label) == ("acme/glider", "acme_envs:Glider-v0", "Glider")
    assert (entry.max_episode_steps, entry.task, entry.kwargs) == (15, "# Glide", {"push": 0.3})
    assert [each.wrapper for each in entry.wrappers] == ["ClipAction"]
    assert catalogue.resolve([str(tmp_path / "glider.toml"), "gym/acrobot"]) == ["gym/acrobot", "acme/glider"]
    assert catalogue.source_of("acme/glider") == str(tmp_path / "glider.toml")
    assert catalogue.entry("acme/glider") == entry


def test_declared_data_lies_in_the_files_folder_and_is_no_hidden_file(tmp_path: Path) -> None:
    home, file = tmp_path / "home", tmp_path / "home" / "glider.toml"
    (home / "maps").mkdir(parents=True)
    (tmp_path / "token").touch()
    (home / ".env").touch()
    (home / "out").symlink_to(tmp_path / "token")

    def data(*names: str) -> tuple[str, ...]:
        listed = ", ".join(map(repr, names))
        file.write_text(f'id = "acme/x"\ngymnasium_id = "a:B-v0"\ndata = [{listed}]')
        return read_file(file)[0].data

    assert data("maps") == (str(home / "maps"),)
    for wrong in ("../token", "/etc/passwd", ".env", "out", ".", "maps/.git"):
        with pytest.raises(ConfigError, match="in the environment file's folder"):
            data(wrong)
    with pytest.raises(ConfigError, match="there is no"):
        data("levels")
    with pytest.raises(ConfigError, match="32 are the limit"):
        data(*["maps"] * 33)


def test_a_file_may_define_several(tmp_path: Path) -> None:
    rows = [f'[[environment]]\nid = "acme/{k}"\ngymnasium_id = "acme_envs:Glider-v0"\n' for k in range(3)]
    (tmp_path / "many.toml").write_text("".join(rows))
    assert [entry.id for entry in read_file(tmp_path / "many.toml")] == ["acme/0", "acme/1", "acme/2"]
    (tmp_path / "many.toml").write_text("".join([*rows, rows[0]]))
    with pytest.raises(ConfigError, match="acme/0 more than once"):
        read_file(tmp_path / "many.toml")


BARE = 'gymnasium_id = "a:B-v0"\n'
LONG = "x" * 2000


WRONG = [
    ("max_steps = 3", "unknown key 'max_steps'; near: max_episode_steps"),
    ('adapter = "toy"', "unknown key 'adapter'"),
    ('max_episode_steps = "3"', "Expected `int`, got `str` - at `\\$.max_episode"),
    ("max_episode_steps = -1", "max_episode_steps is -1"),
    ('wrappers = ["ClipAction"]', "at `\\$.wrappers"),
    ("[kwargs]\nday = 2026-01-01", "kwargs: finite numbers, texts"),
    ("reward_weights = {speed = 1.0}", "reward_weights names speed"),
    ('reward_vector = ["a"]\nreward_weights = {a = nan}', "reward_weights .*: weights have to be finite"),
    ("[kwargs]\nreach = inf", "kwargs: finite numbers"),
    ("[kwargs]\nseed = 99999999999999999999", "kwargs: finite"),
    ('title = "a\\nb"', "title 'a.*b': one line"),
    (f'success = "{LONG}"', "key of info 'xx.*one line of 120"),
    (f'reward_components = {{fuel = "{LONG}"}}', "text 'xx.*1,000 characters at most"),
    ("task_file = 3", "task_file is 3: it has to name a text file"),
    ('family = "../x"', "family '../x': lowercase"),
    ('task_file = "none.md"', "task_file 'none.md' cannot be read"),
]
"""What else an environment says, and what is wrong with it."""


@pytest.mark.parametrize(
    ("text", "why"),
    [
        *((f'id = "acme/x"\n{BARE}{text}', why) for text, why in WRONG),
        ("id = ", "is not TOML"),
        ('id = "acme/x"', "gymnasium_id is missing"),
        (f'id = "../x"\n{BARE}', "id '../x': letters, digits"),
        (f'id = "acme/x@w1"\n{BARE}', "id 'acme/x@w1': letters, digits"),
        (f'id = "gym/acrobot"\n{BARE}', "ids that begin with gym/ ship with evopolicy"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=why) as caught:
        catalogue.add(path)
    assert str(path) in str(caught.value)


def test_a_task_text_comes_from_an_ordinary_file_in_the_folder(tmp_path: Path) -> None:
    """Agents read it, and a package's file could name any file of the machine that reads it."""
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "secret").write_text("the key")
    (home / "link.md").symlink_to(tmp_path / "secret")
    (home / "away").symlink_to(tmp_path)
    os.mkfifo(home / "pipe")
    (home / "long.md").write_text("x" * (2 << 20))
    (home / "latin.md").write_bytes(b"\xe9")
    outside = "outside the environment file's folder .*copy the text into that folder"
    faults = dict.fromkeys(("../secret", str(tmp_path / "secret"), "link.md", "away/secret"), outside)
    faults |= dict.fromkeys(("pipe", "."), "not a regular file")
    faults |= {
        "long.md": "larger than 1,048,576 bytes",
        "latin.md": "is not UTF-8",
        "nul\\u0000": "cannot be read",
    }
    for name, why in faults.items():
        (home / "env.toml").write_text(f'id = "acme/x"\n{BARE}task_file = "{name}"')
        with pytest.raises(ConfigError, match=f"environment acme/x: task_file .*{why}"):
            read_file(home / "env.toml")
    with pytest.raises(ConfigError, match="not a regular file"):
        read_file(home / "pipe")
    (home / "texts").mkdir()
    (home / "texts" / "x.md").write_text("# X")
    (home / "env.toml").write_text(f'id = "acme/x"\n{BARE}task_file = "texts/x.md"')
    assert read_file(home / "env.toml")[0].task == "# X"


def test_foreign_environments_are_named_by_module_or_own_prefix() -> None:
    for name in ("my_pkg:MyEnv-v0", "acme/glider", "acme.envs:Sub/Env-v1"):
        assert catalogue.resolve([name, "gym/acrobot"]) == ["gym/acrobot", name]
        assert catalogue.suite_of(name).name == "other"
    for name in ("gym/acrobat", "acme", "acme/../x", "a b/c", "acme/x@w1", "a:B-v0@w1", "x" * 200 + "/y"):
        with pytest.raises(ConfigError):
            catalogue.resolve([name])


def test_an_installed_package_adds_environments_without_being_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "acme_shop"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "environments.toml").write_text('id = "acme/shop"\ngymnasium_id = "acme_shop:Shop-v0"\n')
    info = tmp_path / "acme_shop-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-shop\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[evopolicy.environments]\nacme = acme_shop:environments.toml\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    catalogue.plugins.cache_clear()
    try:
        found = catalogue.known_entry("acme/shop")
        assert found is not None
        assert found.gymnasium_id == "acme_shop:Shop-v0"
        (package / "environments.toml").unlink()
        catalogue.plugins.cache_clear()
        with pytest.raises(ConfigError, match="names no environment file in the package"):
            catalogue.known_entry("acme/shop")
    finally:
        catalogue.plugins.cache_clear()
