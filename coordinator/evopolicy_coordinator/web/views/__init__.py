"""The pages of the live view, as parts that are updated one by one: all runs, one run, the cluster."""
