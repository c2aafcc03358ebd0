"""The designer's commands. Each module has, for each of its commands, `add_<command>`, which describes it to the
parser, and `<command>_command`, which carries it out and returns an exit code (agent/contract/errors.py).

Modules of this folder import the standard library and light modules only, so that `peakmesh --help` answers at once
and a sensor node started by this program never loads a solver; a command imports what it needs when it is called.
"""

PROBLEM = "problem file, or the name of a built-in problem (peakmesh show lists them)"
