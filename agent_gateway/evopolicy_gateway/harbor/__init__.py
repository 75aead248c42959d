"""Runs of remote agents as tasks for Harbor, which get their reward from the cluster."""
