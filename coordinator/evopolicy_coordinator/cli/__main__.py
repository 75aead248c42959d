"""`python -m evopolicy_coordinator.cli`: the same as `evopolicy-coordinator`."""

from evopolicy_coordinator.cli import program

if __name__ == "__main__":
    program()
