"""The plant, its sensors and its network as one system: eqs. (6)-(11), and what real networks add."""
