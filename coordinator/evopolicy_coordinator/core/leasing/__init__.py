"""From the queue to a worker and back: queue, fleet, leases, their expiry and retries, groups of jobs, pins."""
