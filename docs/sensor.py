"""A sensor of your own for one node: python sensor.py RUN NODE ADDRESS-OF-COORDINATOR"""
import json, queue, sys, zenoh

run, node, address = sys.argv[1:4]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "peer", "connect": {"endpoints": [address]}, "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
    "scouting": {"multicast": {"enabled": False}}}))
with zenoh.open(config) as session:
    modes, tokens = queue.SimpleQueue(), session.liveliness()
    session.declare_subscriber(f"peakmesh/{run}/mode", modes.put)
    out = session.declare_publisher(f"peakmesh/{run}/node/{node}/measurement", congestion_control=zenoh.CongestionControl.BLOCK)
    waiting, seen = {f"peakmesh/{run}/alive/node-{node}", f"peakmesh/{run}/alive/recorder"}, queue.SimpleQueue()
    tokens.declare_subscriber(f"peakmesh/{run}/alive/*", seen.put, history=True)
    while waiting:  # whoever we have seen here has subscribed before, and loses nothing
        waiting.discard(str(seen.get().key_expr))
    token = tokens.declare_token(f"peakmesh/{run}/alive/sensor-{node}")  # the run may start
    while True:  # one mode for each step; here the sensor is read
        step = json.loads(modes.get().payload.to_bytes())["step"]
        out.put(json.dumps({"step": step, "y": [0.0]}))
