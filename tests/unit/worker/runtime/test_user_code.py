"""Which files of the operator's folders an environment's process sees."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

import pytest

from evopolicy_common.catalogue import Entry, Wrapper
from evopolicy_common.errors import SandboxError
from evopolicy_worker.sandbox import user_code


def make(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def shown(folder: Path) -> set[str]:
    return {Path(path).relative_to(folder).as_posix() for path in user_code.modules(str(folder))}


def test_modules_packages_and_metadata_of_a_folder_are_shown(tmp_path: Path) -> None:
    make(tmp_path, "my_env.py", "fast.so", "pack/__init__.py", "pack/maps/1.txt", "x.egg-info/PKG-INFO")
    make(tmp_path, "runs/a.txt", "notes.txt", ".env", ".venv/lib/x.py", "data/1.npy", "scripts/tool.py")
    assert shown(tmp_path) == {"my_env.py", "fast.so", "pack", "x.egg-info"}


def test_private_files_inside_a_package_are_hidden(tmp_path: Path) -> None:
    make(tmp_path, "pack/__init__.py", "pack/a/b.py", "pack/.env", "pack/own.pem", "outside/secret")
    make(tmp_path, "pack/runs/e/v/x/run.json", "pack/state/identity.json", "pack/state/more/x")
    (tmp_path / "pack" / "linked").symlink_to(tmp_path / "outside")
    assert shown(tmp_path) == {"pack/__init__.py", "pack/a"}


def test_a_link_shows_a_file_of_its_own_package_and_no_folder(tmp_path: Path) -> None:
    make(tmp_path, "pack/__init__.py", "pack/.env", "pack/a.txt", "pack/sub/b.txt", "pack/run/run.json")
    make(tmp_path, "outside/__init__.py", "outside/secret", "my_env.py", "pack/run/notes.txt", "near/x.txt")
    targets = {"outside": "../outside/secret", "hidden": ".env", "of_run": "run/notes.txt", "folder": "sub"}
    targets |= {"inside": "sub/b.txt", "nowhere": "gone", "itself": "itself", "by_link": "folder/b.txt"}
    for name, target in targets.items():
        (tmp_path / "pack" / name).symlink_to(target)
    for name, target in {"linked": "outside", "x.libs": "outside", "b.py": "outside/secret"}.items():
        (tmp_path / name).symlink_to(target)
    (tmp_path / "alias.py").symlink_to("my_env.py")
    own = {f"pack/{name}" for name in ("__init__.py", "a.txt", "sub", "inside", "by_link")}
    assert shown(tmp_path) == {*own, "my_env.py", "alias.py", "outside"}
    wrapper = Wrapper(wrapper="linked.secret:Key")
    entry = Entry(id="my/x", gymnasium_id="b:X-v0", wrappers=(wrapper,))
    assert user_code.declared([entry], [str(tmp_path)]) == []


def test_links_in_a_folder_without_hidden_files_stay_links(tmp_path: Path) -> None:
    """Their targets do not exist in the jail, unless they are shown by themselves."""
    make(tmp_path, "pack/__init__.py", "pack/a.txt", "outside/secret")
    (tmp_path / "pack" / "inside").symlink_to("a.txt")
    assert shown(tmp_path) == {"pack"}


def test_declared_data_may_be_a_link_within_its_folder(tmp_path: Path) -> None:
    make(tmp_path, "levels/1.txt", "levels/own.pem", "state/identity.json", "state/x.txt")
    for name, target in {"one": "levels/1.txt", "key": "levels/own.pem", "x": "state/x.txt"}.items():
        (tmp_path / name).symlink_to(target)
    entry = Entry(id="my/x", data=tuple(str(tmp_path / name) for name in ("one", "key", "x")))
    assert user_code.declared([entry], []) == [str(tmp_path / "one"), str(tmp_path / "levels" / "1.txt")]


def test_a_package_with_too_many_files_beside_hidden_ones_is_refused(tmp_path: Path) -> None:
    make(tmp_path, "pack/__init__.py", "pack/.env", *(f"pack/{n}.txt" for n in range(1000)))
    with pytest.raises(SandboxError, match="1,000 are the limit"):
        user_code.modules(str(tmp_path))
    (tmp_path / "pack" / ".env").unlink()
    assert shown(tmp_path) == {"pack"}


def test_a_module_that_an_editable_installation_finds_is_shown_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As setuptools installs a project by reference: a finder knows where each module is."""
    make(tmp_path, "linked_env/__init__.py", "runs/x/run.json", ".env", "namespace/inner.py")

    class Finder:
        @staticmethod
        def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
            return PathFinder.find_spec(name, [str(tmp_path)]) if name == "linked_env" else None

    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder])
    linked = Entry(id="my/linked", gymnasium_id="linked_env:X-v0")
    assert user_code.declared([linked], []) == [str(tmp_path / "linked_env")]
    spaced = Entry(id="my/spaced", gymnasium_id="namespace.inner:X-v0")
    assert user_code.declared([spaced], [str(tmp_path)]) == [str(tmp_path / "namespace")]
    assert user_code.declared([Entry(id="my/missing", gymnasium_id="nowhere:X-v0")], []) == []
