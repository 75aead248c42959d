"""`python -m evopolicy_gateway.cli`: the same as `evopolicy`."""

from evopolicy_gateway.cli.main import main

if __name__ == "__main__":
    main()
