"""The runtime's commands: `run`, and one for each role.

Modules of this folder import the standard library and light modules only; a command imports what it needs when it is
called, so that a process loads what its role takes and no more.
"""
