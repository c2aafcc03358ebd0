"""A participant's place on the network. Roles talk to `bus`; behind it, `session` alone imports zenoh."""
