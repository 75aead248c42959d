"""`python -m evopolicy_coordinator.cli`: the same as `evopolicy-coordinator`."""

from evopolicy_coordinator.cli.main import main

if __name__ == "__main__":
    main()
