"""How the bound goes with the losses, for gains of one's own and for gains designed for each: python sweep.py [PNG]."""

import sys

import numpy as np
import peakmesh
from matplotlib.figure import Figure

problem = peakmesh.find("two-nodes")
mine = {"linked": {i: {j: 0.25 * np.eye(1) for j in problem.node_names} for i in problem.node_names}}  # K, and H too
arrival = [0.6, 0.8, 1.0]

own, designed = [], []
for probability in arrival:
    lossy = problem.with_(node={"*": {"arrival_probability": probability}})
    own.append(peakmesh.analyse(lossy, (mine, mine)).ladder.exact[1])
    designed.append(peakmesh.design(lossy, method="decomposed").gamma)
    print(f"{probability:.1f}  mine {own[-1]:.6f}  designed {designed[-1]:.6f}")

if sys.argv[1:]:
    figure = Figure(figsize=(3.5, 2.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(arrival, own, "o-", label="mine")
    axes.plot(arrival, designed, "s-", label="designed")
    axes.set(xlabel="probability that a measurement arrives", ylabel="γ")
    axes.legend()
    figure.savefig(sys.argv[1], dpi=300)
