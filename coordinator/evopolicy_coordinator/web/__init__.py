"""The live view in a browser: sweeps, runs, and the cluster, for operators. An operator's process beside the
coordinator."""
