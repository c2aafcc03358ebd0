"""Certificates, proved in ball arithmetic without a solver: (17) and (18), and the recursion of the exact gain."""
