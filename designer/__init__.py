"""The mathematics of peakmesh, seen centrally: design, verification, replay, pictures."""
