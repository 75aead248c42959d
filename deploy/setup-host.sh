#!/usr/bin/env bash
# Installs the system packages that evopolicy needs: bubblewrap, the sandbox of policies and agents; with --tests, also those of `make test`;
# with --all-tests, those of all its layers but one, with --cluster those of `make test-cluster`.
# As root on Debian or Ubuntu it installs them; otherwise it says exactly what to install, and what does not work without it, and goes on.
set -euo pipefail
PATH="$PATH:/usr/sbin:/sbin" # where an ordinary user of Debian has no ip and no ldconfig

missing=()
losses=()
need() { # need 'PACKAGES' 'WHAT DOES NOT WORK WITHOUT THEM' COMMAND...: the command fails where they are missing
  "${@:3}" >/dev/null 2>&1 && return
  read -ra packages <<<"$1"
  missing+=("${packages[@]}")
  losses+=("$1: $2")
}
has_postgres() { command -v initdb || compgen -G "/usr/lib/postgresql/*/bin/initdb"; }
has_egl() { [[ "$(ldconfig -p)" == *libEGL.so.1* ]]; }

need bubblewrap "policies and agents run with --tier none --jail none only, make demo does not run, and tests fail" command -v bwrap
case "${1:-}" in --tests | --all-tests)
  need iproute2 "tests on several hosts are left out" command -v ip
  need systemd "the tests of the systemd units are left out" command -v systemd-analyze
  need "libegl1 libegl-mesa0 libgl1-mesa-dri" "MuJoCo environments have no videos, and tests of videos are left out; everything else works" has_egl
  ;;
esac
if [ "${1:-}" = "--cluster" ]; then
  need postgresql "the tests of the store on PostgreSQL are left out" has_postgres
fi
if [ "${1:-}" = "--all-tests" ]; then
  need "gcc libc6-dev" "the tests with bad clocks and bad disks fail" command -v cc
  need "slurmctld slurmd slurm-client munge" "the tests on Slurm are left out" command -v slurmctld
  need chromium "environments that are web pages do not run, and the tests in a browser are left out" command -v chromium
fi
[ ${#missing[@]} -eq 0 ] && exit 0

if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null 2>&1; then
  echo "installing ${missing[*]} with apt-get"
  apt-get install -y -q --no-install-recommends "${missing[@]}" >/dev/null 2>&1 || {
    apt-get update -q >/dev/null
    apt-get install -y -q --no-install-recommends "${missing[@]}" >/dev/null
  }
  exit 0
fi

case "$(uname -s)" in
  Linux)
    echo "note: packages are missing, and without them:"
    printf '    %s\n' "${losses[@]}"
    echo "To install them:"
    echo "    Debian, Ubuntu:  sudo apt-get install ${missing[*]}"
    echo "    Fedora:          sudo dnf install ${missing[*]}"
    echo "    Arch:            sudo pacman -S ${missing[*]}" ;;
  *)
    echo "note: workers run on Linux (or WSL2) only; on this system the coordinator, the gateway and reports work." ;;
esac
