"""The two labs of docs/how-to/leaderboard.md: the page's own commands, a clean installation, and the site in
Chromium.

Attacks, each with its defence:
- a changed, truncated, or repeated file, or names with markup, in a leaderboard: the file is listed
  separately with the reason; markup appears as text.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from browser import Page
from commands import words
from publications import read, written

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]
ROOT = Path(__file__).parents[3]


def script() -> str:
    page = (ROOT / "docs" / "how-to" / "leaderboard.md").read_text()
    found = re.search(r"```bash\n(.*?)```", page, re.DOTALL)
    return found[1]


def run(cwd: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        words,
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == code, f"{words}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labs")
    done = run(folder, "bash", "-euo", "pipefail", "-c", script())
    assert done.stdout.count("bit for bit") + done.stdout.count("ok     replay") >= 2, done.stdout
    assert done.stdout.count("the signer is the one that you named") == 2
    return folder


def key(labs: Path, lab: str) -> str:
    return run(labs, "evopolicy-coordinator", "identity", "--state", lab).stdout.strip()


def front(page: Page, site: Path) -> str:
    page.problems.clear()
    for path in sorted(site.rglob("*.html")):
        page.open(path)
        assert page.run("document.querySelector('h1').textContent.length") > 3
        broken = page.run(
            "[...document.querySelectorAll('a[href]')].map((a) => a.getAttribute('href')).filter((h) =>"
            " /^https?:/.test(h))"
        )
        assert broken == [], path
    assert page.problems == []
    for path in sorted(site.rglob("*.html")):
        for href in re.findall(r'href="([^"#:]+)(?:#[^"]*)?"', path.read_text()):
            assert (path.parent / href).exists(), (path, href)
    page.open(site / "index.html")
    return str(page.run("document.body.innerText"))


def test_the_labs_have_keys_of_their_own_and_one_board(labs: Path) -> None:
    assert key(labs, "lab-a") != key(labs, "lab-b")
    with Page() as page:
        text = front(page, labs / "site")
        rows = page.run(
            "[...document.querySelectorAll('#leaderboard-table-1 tbody th')].map((cell) => cell.textContent.trim())"
        )
        page.screenshot(labs / "site.png")
    assert set(rows) == {"evolve", "random", "Random policy"}
    assert not (labs / "site" / "board-2").exists()
    assert "Lab-A" in text
    assert "Lab-B" in text
    assert "Tie group" in text
    assert "self-signed" not in text
    assert len(list((labs / "site" / "board-1" / "traces").glob("*.html"))) == 4
    assert len(list((labs / "site" / "episodes").glob("*.html"))) == 4


def test_a_clean_installation_checks_both_files(labs: Path, tmp_path: Path) -> None:
    """Only what the wheel holds, beside the third-party packages of this environment; a home and a state of its own."""
    dist = tmp_path / "dist"
    run(ROOT, sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(dist))
    (wheel,) = dist.glob("*.whl")
    run(tmp_path, sys.executable, "-m", "venv", "--without-pip", "venv")
    (packages,) = (tmp_path / "venv" / "lib").glob("python3*/site-packages")
    import site

    (packages / "third_party.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    python = str(tmp_path / "venv" / "bin" / "python")
    options = ("-q", "--no-deps", "--no-index", "--ignore-installed")
    run(tmp_path, python, "-m", "pip", "install", *options, str(wheel))
    where = run(tmp_path, python, "-c", "import evopolicy_coordinator as e; print(e.__file__)").stdout
    assert where.startswith(str(tmp_path))
    for lab in ("lab-a", "lab-b"):
        shutil.copy(labs / f"{lab}.evp", tmp_path)
        command = [
            str(tmp_path / "venv" / "bin" / "evopolicy"),
            *words(f"check {lab}.evp --json --replay 25%"),
        ]
        done = run(tmp_path, *command, "--identity", key(labs, lab))
        document = json.loads(done.stdout)
        assert document["ok"]
        states = {each["kind"]: each["state"] for each in document["findings"]}
        assert (states["identity"], states["replay"]) == ("ok", "ok")


def test_incomparable_and_failed_results_stand_apart_with_the_reason(labs: Path, tmp_path: Path) -> None:
    files = read(labs / "lab-b.evp")
    document = json.loads(files["runs/0000/run.json"])
    assert document["agent"]["entry"] == "evolve"
    document["agent"]["entry"] = "<script>alert(1)</script>"
    written(tmp_path / "<b>forged.evp", files | {"runs/0000/run.json": json.dumps(document).encode()})
    (tmp_path / "torn.evp").write_bytes((labs / "lab-a.evp").read_bytes()[:5000])
    # Another budget: no comparison with the first two.
    sweep = (labs / "sweep.toml").read_text().replace("budget = 8", "budget = 6")
    (tmp_path / "third.toml").write_text(sweep.replace('"random"', '"evolve"'))
    state, data = ("--local", "--state", "lab-c"), str(labs / "cases")
    run(tmp_path, "evopolicy", "suite", "third.toml", *state, "--data", data, "--runs", "runs-c")
    run(tmp_path, "evopolicy", "publish", "runs-c", *state, "--out", "lab-c.evp")
    names = [str(labs / "lab-a.evp"), str(labs / "lab-b.evp"), "lab-c.evp", "<b>forged.evp", "torn.evp"]
    names.append(str(shutil.copy(labs / "lab-a.evp", tmp_path / "again.evp")))
    done = run(tmp_path, "evopolicy", "leaderboard", *names, "--out", "site")
    lines = [line for line in done.stderr.splitlines() if line.startswith("not shown: ")]
    refused = dict(line.removeprefix("not shown: ").split(": ", 1) for line in lines)
    assert refused.keys() == {"<b>forged.evp", "torn.evp", "again.evp"}
    assert "run.json was changed" in refused["<b>forged.evp"]
    assert "not published results" in refused["torn.evp"]
    assert "is also in lab-a.evp" in refused["again.evp"]
    with Page() as page:
        text = front(page, tmp_path / "site")
        assert page.run("document.querySelectorAll('main b').length") == page.run(
            "document.querySelectorAll('main .note > b').length"
        )
    assert "episode budget on toy: 6 (2 runs), 8 (4 runs)" in text
    # Two signers have an entry of one name: each is one of its own.
    assert text.count("evolve (key ") >= 2
    assert "3 of 3 files are self-signed" in text


def test_bad_wishes_are_refused(labs: Path, tmp_path: Path) -> None:
    none = run(tmp_path, "evopolicy", "leaderboard", "none.evp", "--out", "site", code=2)
    assert "there is no such file" in none.stderr
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    mine = ("evopolicy", "leaderboard", str(labs / "lab-a.evp"))
    assert "other files" in run(tmp_path, *mine, "--out", "full", code=2).stderr
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"
    assert "64 hexadecimal" in run(tmp_path, *mine, "--out", "site", "--identity", "abc", code=2).stderr
    (tmp_path / "bad.evp").write_bytes(b"no")
    run(tmp_path, "evopolicy", "leaderboard", "bad.evp", "--out", "site", code=1)
    assert "Not shown" in (tmp_path / "site" / "index.html").read_text()
