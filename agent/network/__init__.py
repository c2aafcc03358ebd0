"""A participant's place on the network: the only folder that imports zenoh."""
