"""Designs a network, runs it, tells how far it is, judges and draws the recording: python live.py [FOLDER]."""

import sys
from pathlib import Path

import peakmesh

folder = Path(sys.argv[1] if sys.argv[1:] else ".")
gains = peakmesh.design("two-nodes", method="decomposed")


def tell(word):
    """What happens in the run, as it does."""
    if "complete" in word:
        print(f"{word['complete']} steps")


run = peakmesh.run(gains, folder / "live.mcap", steps=100, report=tell)
print(run.replay().text())
for name, figure in peakmesh.figures(run.recording, width=3.5).items():
    if name in ("outputs", "errors"):
        figure.savefig(folder / f"{name}.pdf")
