"""The jails of environment and policy processes."""
