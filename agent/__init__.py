"""The runtime of peakmesh: what runs on a device. Imports numpy, zenoh, pydantic; mcap only in the recorder."""
