"""What workers ask and hand in: membership, polls for leases and who gets them, hand-ins."""
