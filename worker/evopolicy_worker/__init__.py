"""The worker: leases jobs and plays their episodes, with each environment in a jail and each policy in a sandbox."""
