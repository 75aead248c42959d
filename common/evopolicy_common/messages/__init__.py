"""The wire messages, one module per kind of client (worker, gateway, operator): msgspec structs over msgpack."""
