"""What workers ask and report: membership, polls for leases and who gets them, result reports."""
