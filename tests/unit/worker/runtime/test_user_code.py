"""Which files of the operator's folders an environment's process sees."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

import pytest

from evopolicy_common.catalogue import Entry
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
