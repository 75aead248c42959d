"""Agents and hidden jobs exclude each other on a kernel: permits, the gateways' requests for them, and precedence."""
