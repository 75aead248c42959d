"""The coordinator's commands: `evopolicy-coordinator …`, and those that it adds to `evopolicy`."""
