"""A run without processes and without a network: the production roles on a simulated bus, under a virtual clock.

Everything that a seed decides comes about the same every time: who takes part, what befalls them, how long each message
and each reaction takes. `machine` has the clock and the processes, `stand_ins` what their modules see instead of the
clock, threads and queues of this machine, `network` and `door` take the place of zenoh, `scenario` is what a seed asks
for, `world` makes it happen, `laws` says what must hold whatever happened.
"""
