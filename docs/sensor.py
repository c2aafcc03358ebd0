"""A sensor of your own for one node: python sensor.py RUN NODE ADDRESS-OF-COORDINATOR [KEYS]."""

import json
import queue
import sys

import zenoh

base, node = f"peakmesh/{sys.argv[1]}", sys.argv[2]
config = zenoh.Config.from_file(sys.argv[4]) if sys.argv[4:] else zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps([sys.argv[3]]))
config.insert_json5("listen/endpoints", "[]")  # nobody needs to connect to it
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    modes, tokens, waiting = queue.SimpleQueue(), queue.SimpleQueue(), {f"node-{node}", "recorder", "coordinator"}
    session.declare_subscriber(f"{base}/mode", modes.put)
    session.liveliness().declare_subscriber(f"{base}/alive/*", tokens.put, history=True)
    while waiting:  # whoever is seen here has subscribed before, and will miss nothing
        waiting.discard(str(tokens.get().key_expr).rpartition("/")[2])
    session.liveliness().declare_subscriber(f"{base}/alive/coordinator", modes.put)  # its end: an empty payload
    ready = session.liveliness().declare_token(f"{base}/alive/sensor-{node}")  # now the run may start
    while mode := modes.get().payload.to_string():  # one for each step: read the sensor, publish y
        y = json.dumps({"step": json.loads(mode)["step"], "y": [0.0]})
        session.put(f"{base}/node/{node}/measurement", y, congestion_control=zenoh.CongestionControl.BLOCK)
