"""The mathematics of peakmesh, seen centrally: design, verification, replay, pictures.

the model       error_model; units: natural ones
any gains       gain: their exact gain; sensitivity: its derivative; worst_case: the disturbances that attain it;
                floor: below which no gains get; analysis: all of that for somebody else's gains; ladder: its lines
the search      descent, along the barrier, by bfgs, from consensus gains; exact_design: from problem to gains that way
the LMI         lmi: Theorem 2, and node by node; inwards, back_off: from its solution to a P that can be proved
the design      synthesis: one method or another; effort: which by default; diagnosis: why there is no solution
the proof       certificate, exact_certificate, of ball_model, in balls
what if         what_if: without a node or a link; workers: many designs or runs at once
runs            simulation: thousands; replay: one recording; figures: its pictures; show: what a file is
the paper       reproduce: its table; problems: its examples, and others
the program     cli, commands
"""
