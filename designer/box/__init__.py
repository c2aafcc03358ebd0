"""Gamma for every model in a box: probabilities are estimated, and the gains have to hold for what they really are."""
