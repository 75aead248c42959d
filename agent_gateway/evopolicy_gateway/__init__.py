"""The agent gateway: one run's HTTP service, workspace, feedback tree and agent; and the `evopolicy` command."""
