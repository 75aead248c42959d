"""One run, from its opening to `run.json`."""
