"""The wire messages, one module per kind of client (worker, gateway, operator); all are msgspec structs over
msgpack."""
