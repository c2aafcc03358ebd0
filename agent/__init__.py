"""The runtime of peakmesh: what runs on a device. Imports numpy, zenoh, pydantic; mcap only in the recorder.

the rooms       contract: what both packages share, files, keys and messages; network: a participant's place on it;
                roles: node, plant, coordinator, recorder; commands: what the program does
a node's step   inbox: what must be there before it; filter: eqs. (4) and (5); product: its sums;
                estimates: what is told of it; embed: the same in C, for a device
the clock       pacing: a run against it, as data; faults: what such a run is to survive
a whole run     plan: what the coordinator decides; receipts: what the recorder has; launch: every role on this machine
                nursery: the process that they are forked from; children: how it is spoken to
                guests: programs of the user's in place of roles; conform: whether such a program does what a node does
                within: a role of ours in a thread of somebody's process
                authority: everybody's certificates; guard: what may come in; refusals: what is told of the rest
the machine     cli: the program; signals: what asks it to end; doctor: whether a run would go well
"""
