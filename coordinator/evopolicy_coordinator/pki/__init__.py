"""Certificates: a cluster's own authority, and the machines that it has admitted."""
