"""A sensor of your own for one node: python sensor.py RUN NODE ADDRESS-OF-COORDINATOR [KEYS]."""

import json
import queue
import sys

import zenoh

if len(sys.argv) not in (4, 5):
    sys.exit(f"{__doc__} For example: python sensor.py zhu2020-lossy 3 tcp/127.0.0.1:7447")
base, node, address = f"peakmesh/{sys.argv[1]}", sys.argv[2], sys.argv[3]
try:
    config = zenoh.Config.from_file(sys.argv[4]) if sys.argv[4:] else zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([address]))
except zenoh.ZError:
    sys.exit(f"sensor.py {' '.join(sys.argv[1:])}: no address like tcp/127.0.0.1:7447, or no KEYS like sensor-3.json5")
config.insert_json5("listen/endpoints", "[]")  # nobody needs to connect to it
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    modes, tokens, waiting = queue.SimpleQueue(), queue.SimpleQueue(), {f"node-{node}", "recorder", "coordinator"}
    session.declare_subscriber(f"{base}/mode", modes.put)
    session.liveliness().declare_subscriber(f"{base}/alive/*", tokens.put, history=True)
    while waiting:  # whoever is seen here has subscribed before, and will miss nothing
        try:
            waiting.discard(str(tokens.get(timeout=10).key_expr).rpartition("/")[2])
        except queue.Empty:
            print(f"sensor.py waits for {', '.join(sorted(waiting))} of {base} at {address}", file=sys.stderr)
    session.liveliness().declare_subscriber(f"{base}/alive/coordinator", modes.put)  # its end: an empty payload
    ready = session.liveliness().declare_token(f"{base}/alive/sensor-{node}")  # now the run may start
    while mode := modes.get().payload.to_string():  # one for each step: read the sensor, publish y
        y = json.dumps({"step": json.loads(mode)["step"], "y": [0.0]})
        session.put(f"{base}/node/{node}/measurement", y, congestion_control=zenoh.CongestionControl.BLOCK)
