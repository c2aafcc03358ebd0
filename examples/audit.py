"""Replays every recording in a folder: python audit.py FOLDER. The exit code is that of the worst."""

import sys
from pathlib import Path

import peakmesh

worst = 0
for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
    try:
        verdict = peakmesh.replay(path)
    except peakmesh.PeakmeshError as error:  # no recording
        print(error)
        worst = max(worst, error.exit_code)
        continue
    peak = "-" if verdict.peak is None else f"{verdict.peak.size:.4g}"
    print(f"{path.name}: {verdict.headline()}; {verdict.steps} steps, peak {peak}, largest gap {verdict.worst_gap:.1e}")
    worst = max(worst, verdict.exit_code)
sys.exit(worst)
