"""What gains really guarantee: the exact gain, its derivatives, what attains it, and what nobody can beat."""
