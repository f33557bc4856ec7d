"""The wool skirt of the second subject: its cut, its constants and its simulation by Blender.

Blender's solver treats the cloth as points joined by springs, integrates them implicitly and resolves
contacts by impulses, so its cloth has other habits than that of `cloth.py`. It runs in a Python of its own
(`bpy` wants an older numpy), through `blender_cloth.py`.
"""

import json
import subprocess
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from capture.cloth import GRAVITY
from capture.garment import Cut, Skirt, build_collider_mesh, hang, pose_points, prepend_pre_roll
from dsar.types import Body, Motion

WOOL_CUT = Cut(
    columns=64, rows=22, band_rows=2, length=0.74, flare=2.4, wave=0.02, lowest=-0.79, hands=False,
    painted=(4, 5), stored=(2, 1),
)  # fmt: skip
"""Hands do not collide: they scoop up cloth that hangs on them for the rest of a sequence."""
SOLVER = Path(__file__).with_name("blender_cloth.py")
PRE_ROLL = 60
_GUST = 35


@dataclass(frozen=True)
class Wool:
    """Constants of Blender's cloth, in its own units."""

    mass: float = 0.5
    """Of a vertex. Gravity does not depend on it, all stiffness and the air do."""
    quality: int = 7
    """Solver steps a frame."""
    contacts: int = 3
    """Rounds of contacts a step."""
    stretch: float = 40.0
    stretch_damping: float = 20.0
    shear: float = 20.0
    shear_damping: float = 15.0
    bend: float = 5.0
    bend_damping: float = 2.0
    air: float = 3.0
    """Damping by air, hundredths a second and unit of mass."""
    friction: float = 8.0
    thickness: float = 0.009
    """Distance kept from the body, metres."""


def drape_wool(
    body: Body,
    skirt: Skirt,
    motion: Motion,
    wool: Wool,
    python: Path,
    seed: int,
    disturbance: float = 0.0,
) -> Float[ndarray, "f n 3"]:
    """Return the skirt's vertices at every recorded frame of a motion.

    Args:
        body: The body at rest.
        skirt: The fitted skirt.
        motion: What the body does from frame 0; the cloth comes to rest before it.
        wool: Constants of the cloth.
        python: A Python that can import `bpy`.
        seed: Of the irregularity that the folds start from.
        disturbance: Peak in m/s^2 of a sideways pull early in the pre-roll only: a second true run.

    Raises:
        CalledProcessError: Blender failed; its message is on the error stream.
    """
    rolled = prepend_pre_roll(motion, PRE_ROLL)
    anchors = pose_points(body, rolled, skirt.band, skirt.band_weights)
    posed, faces = build_collider_mesh(body, rolled, skirt.cut)
    gravity = np.tile([0.0, -GRAVITY, 0.0], (len(rolled), 1))
    gust = disturbance * np.sin(np.linspace(0, np.pi, _GUST))
    gravity[:_GUST] += gust[:, None] * np.array([0.8, 0.0, 0.6])
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder) / "job.npz", Path(folder) / "result.npz"
        np.savez(
            job,
            start=hang(skirt, anchors[0].astype(float), seed),
            quads=grid_quads(skirt.cut),
            anchors=anchors,
            body=posed,
            body_faces=faces,
            fps=motion.fps,
            gravity=gravity,
            settings=json.dumps(asdict(wool)),
        )
        command = [str(python), str(SOLVER), str(job), str(result)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return np.load(result)["cloth"][PRE_ROLL:]


def grid_quads(cut: Cut) -> Int[ndarray, "q 4"]:
    """Return the four-sided faces of the closed grid, counter-clockwise seen from outside."""
    row, column = np.meshgrid(np.arange(cut.rows - 1), np.arange(cut.columns), indexing="ij")
    a, b = row * cut.columns + column, row * cut.columns + (column + 1) % cut.columns
    return np.stack([a, a + cut.columns, b + cut.columns, b], -1).reshape(-1, 4)
