#!/usr/bin/env bash
# Builds wheel and sdist into dist/, checks them, and installs each into clean environments: release.sh PYTHON
# With pip, and with uv and pipx where they are installed. In each it plays a run of the environment without a simulator.
set -euo pipefail
cd "$(dirname "$0")/.."
python="$1"
rm -rf dist
"$python" -m hatchling build
"$python" -m twine check --strict dist/*
wheel="$(readlink -f dist/*.whl)"
sdist="$(readlink -f dist/*.tar.gz)"
scratch="$(mktemp -d /tmp/evp-XXXXXX)"
trap 'rm -rf "$scratch"' EXIT
export UV_CONSTRAINT="$PWD/constraints.txt" PIP_CONSTRAINT="$PWD/constraints.txt"
export UV_TOOL_DIR="$scratch/tools" UV_TOOL_BIN_DIR="$scratch/uv" PIPX_HOME="$scratch/pipx-home" PIPX_BIN_DIR="$scratch/pipx"

plays() { # plays FOLDER NAME: the programs in the folder work, outside this clone
  (cd "$scratch" && "$1/evopolicy" --version &&
    "$1/evopolicy" local --env toy/line --agent evolve --budget 4 --validation 1 --heldout 2 --fresh --runs "runs-$2")
  echo "ok: $2"
}

for each in "$wheel" "$sdist"; do
  kind="pip-${each##*.}"
  "$python" -m venv "$scratch/$kind"
  "$scratch/$kind/bin/python" -m pip install -q --disable-pip-version-check "evopolicy[local] @ file://$each"
  plays "$scratch/$kind/bin" "$kind"
done
if command -v uv >/dev/null; then
  uv tool install -q --python "$python" "evopolicy[local] @ file://$wheel"
  plays "$scratch/uv" uv
else
  echo "left out: uv is not installed"
fi
if command -v pipx >/dev/null; then
  pipx install -q --python "$python" "evopolicy[local] @ file://$wheel"
  plays "$scratch/pipx" pipx
else
  echo "left out: pipx is not installed"
fi
