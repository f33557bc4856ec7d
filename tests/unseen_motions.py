"""Unseen motions for the tiny capture."""

import json
from pathlib import Path

import numpy as np

STEPS = np.array([[[100, 200, 300]], *([[[1, 0, -2]]] * 13)], np.int16)


def add_unseen(folder: Path, **entries: dict) -> None:
    """Add sequences to the record of a tiny capture: the motion of `turn`, a garment of one vertex."""
    np.savez(folder / "garment.npz", run0=STEPS, run1=2 * STEPS, unit=0.001, faces=np.zeros((1, 3), np.int32))
    record = json.loads((folder / "capture.json").read_text())
    for name, changes in entries.items():
        entry = {"motion": "motion/turn.npz", "images": None, "frames": 14, "garment": "garment.npz"}
        record["sequences"][name] = {**entry, "split": "unseen_test", "labels": [], **changes}
    (folder / "capture.json").write_text(json.dumps(record))
