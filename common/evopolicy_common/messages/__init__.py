"""The wire messages, by who speaks: workers, gateways, operators; all msgspec structs over msgpack."""
