"""Certificates, proved without a solver: (17) and (18), and the recursion of the exact gain, in floats or in balls."""
