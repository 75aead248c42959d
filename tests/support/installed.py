"""Tools whose requirements exclude versions that are tested here: installations of their own, which also have
everything of this one. They are made once and kept in `build/`."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).parents[2]


def python_with(name: str, *requirements: str) -> Path:
    """The interpreter of a virtual environment that has these packages before those of this one.

    Its packages come from the package index when it is made, and when `requirements` or this interpreter change.
    """
    here = sysconfig.get_path("purelib")
    told = "\n".join([sys.version, here, *requirements])
    folder = ROOT / "build" / "installed" / f"{name}-{hashlib.sha256(told.encode()).hexdigest()[:12]}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    python = folder / "bin" / "python"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if (folder / "complete").exists():
            return python
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        own = subprocess.check_output(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True
        ).strip()
        # `addsitedir` reads the .pth files there too, by which the project itself is found.
        Path(own, "_tested.pth").write_text(f"import site; site.addsitedir({here!r})\n")
        install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements]
        done = subprocess.run([python, *install], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-4000:]
        (folder / "complete").touch()
    return python
