"""A local cluster: coordinator and workers of one command, as child processes on this machine."""
