"""A sound cloud of records, and one frame in the small formats."""

from pathlib import Path

import numpy as np
import pytest
from splat_files import COUNT, NAMES

from dsar_exporters import CompressedPlySequence, GltfSnapshot, SpzSequence, export


@pytest.fixture
def cloud() -> np.ndarray:
    """A sound cloud as an optimiser leaves it: a person's size, quaternions of any length."""
    random = np.random.default_rng(0)
    vertices = np.zeros(COUNT, [(name, "<f4") for name in NAMES])
    for name in NAMES:
        vertices[name] = random.normal(size=COUNT)
    for name in "xyz":
        vertices[name] *= 0.5
    vertices["opacity"] *= 3
    for name in ("scale_0", "scale_1", "scale_2"):
        vertices[name] = vertices[name] / 2 - 4.5
    return vertices


@pytest.fixture
def written(make_sequence, tmp_path) -> dict[str, Path]:
    """One frame of 600 Gaussians with harmonics of degree 1, in the small formats."""
    sequence = make_sequence(600, degree=1, frames=1)
    small = (CompressedPlySequence(tmp_path / "ply", "a"), SpzSequence(tmp_path / "spz", "a"))
    export(sequence, [*small, GltfSnapshot(tmp_path / "a.glb")])
    paths = {output.suffix.removeprefix("."): output.frame_path(1001) for output in small}
    return {**paths, "glb": tmp_path / "a.glb"}
