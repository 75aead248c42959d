"""The worker: leases episode jobs and plays them, the environment here, the policy locked in a sandbox."""
