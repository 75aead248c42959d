"""Files that outlive a process: blobs, bundles, trajectories, `run.json`, `summary.json`."""
