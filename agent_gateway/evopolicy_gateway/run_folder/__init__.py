"""The files of a run's folder while it is open: their layout, the gateway's journal, locks, names, and its address."""
