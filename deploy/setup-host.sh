#!/usr/bin/env bash
# Installs the system packages that evopolicy needs: bubblewrap, the policies' sandbox; with --tests, what `make test` uses too;
# with --all-tests, what all layers of tests use.
# As root on Debian or Ubuntu it installs them; otherwise it says exactly what to install and goes on.
set -euo pipefail

missing=()
command -v bwrap >/dev/null 2>&1 || missing+=(bubblewrap)
if [ "${1:-}" = "--tests" ] || [ "${1:-}" = "--all-tests" ]; then
  # What only the tests use: network namespaces, a compiler for a clock that jumps, systemd's check of units, drawing
  # without a display.
  command -v ip >/dev/null 2>&1 || missing+=(iproute2)
  command -v cc >/dev/null 2>&1 || missing+=(gcc libc6-dev)
  command -v systemd-analyze >/dev/null 2>&1 || missing+=(systemd)
  ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' || missing+=(libegl1 libegl-mesa0 libgl1-mesa-dri)
fi
if [ "${1:-}" = "--all-tests" ]; then
  # Slurm on one node, and a browser for reports, the live view, and environments that are web pages.
  command -v slurmctld >/dev/null 2>&1 || missing+=(slurmctld slurmd slurm-client munge)
  command -v chromium >/dev/null 2>&1 || missing+=(chromium)
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
    echo "note: ${missing[*]} is missing. Policies will not run in the default sandbox until it is installed:"
    echo "    Debian, Ubuntu:  sudo apt-get install ${missing[*]}"
    echo "    Fedora:          sudo dnf install ${missing[*]}"
    echo "    Arch:            sudo pacman -S ${missing[*]}" ;;
  *)
    echo "note: workers run on Linux (or WSL2) only; on this system the coordinator, the gateway and reports work." ;;
esac
