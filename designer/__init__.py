"""The mathematics of peakmesh, seen centrally: design, verification, replay, report.

the rooms       model: eqs. (6)-(11); gain: what gains really guarantee; lmi: Theorem 2, and gains by it;
                search: gains of least exact gain; proof: certificates, without a solver; box: every model
                in a box; ledger: the bound through faults; replay: one recording, judged; identify: recordings against
                probabilities; report: how it looks; export: tables of it; watch: a run that goes on, as it is seen;
                problems: the paper's examples, and others; commands: what the program does
the design      decay: whether errors die out; invariants: P of (17), and what no error comes back from; steered:
                what w alone moves; synthesis: one method or another; diagnosis: why there is no solution; ladder: what
                a design is worth; undercut: what no gains have less than by an LMI; beyond_gamma: noise, and each node
                by itself; start: an initial error; single_run, chance: what one run keeps with a probability
other answers   analysis: somebody else's gains; ranking: gains beside others; stacked: gains as one matrix
                for each mode; what_if: without a node or a link; sweep: over values of a key; reproduce: the paper's
                table; simulation: thousands of runs; show: what a file is; compare: two recordings beside each other
                conformity: the networks that a program is tried in which takes a node's place
the machine     workers: many designs or runs at once; patience: budgets, and who asks for an end; coordinates:
                states in which M does not cancel; cli: the program
"""
