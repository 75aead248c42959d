"""Requests of workers: membership, polls and the leases granted to them, result reports."""
