"""Whether a program can take a node's place: it is run against everybody else of a run, who are played here.

`play` is what the others say, `judge` what the node must say, both pure; `stage` is where they meet, `trials` what is
tried. A program is judged by what comes over the network alone, so it may be in any language.
"""
