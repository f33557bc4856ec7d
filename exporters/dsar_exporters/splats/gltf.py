"""glTF with KHR_gaussian_splatting: one frame, for the web and for engines."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsar.atomic_files import atomic_write
from dsar.errors import ExportError
from dsar.geometry.harmonics import C0
from dsar.types import Gaussians, GaussianSequence
from dsar_exporters.delivery import Sink
from dsar_exporters.manifest import manifest_path, write_manifest
from dsar_exporters.optional import require

_FLOATS = 3 + 4 + 3 + 1 + 4
"""Position, rotation, scale, opacity and the colour for readers that know no splats, of a Gaussian."""
_STEPS, _REACH = 255, 4.0
"""fourdgs takes higher harmonics in bytes: this many steps from minus to plus this much."""


@dataclass(frozen=True)
class GltfSnapshot:
    """The first frame as GLB; the extension has no way to animate Gaussians.

    Colours are display-referred sRGB, and the file says so. Harmonics above the constant are rounded to
    steps of 0.03, because fourdgs, which writes the file, takes them in bytes.
    """

    path: Path
    """A `.glb`."""

    @contextmanager
    def open_sink(self, sequence: GaussianSequence) -> Iterator[Sink]:
        """Take frames, keep the first; see `Output`.

        Raises:
            ExportError: The name does not end in .glb, or there are no Gaussians.
            MissingDependencyError: fourdgs is not installed.
        """
        if self.path.suffix.lower() != ".glb":
            raise ExportError(f"{self.path}: expected a name ending in .glb: rename the output")
        fourdgs = require("fourdgs", feature="GLB", package="fourdgs", extra="ply")
        frames = sequence.frame_numbers[:1]
        with atomic_write(self.path) as draft:

            def write(frame: int, gaussians: Gaussians) -> None:
                if frame == frames[0]:
                    _write_glb(fourdgs, gaussians, draft.with_name("draft.glb"))

            yield write
            draft.with_name("draft.glb").replace(draft)
        first = GaussianSequence(
            frames,
            sequence.fps,
            sequence.num_gaussians,
            sequence.produce,
            sequence.provenance,
            guarded={frame: found for frame, found in sequence.guarded.items() if frame == frames[0]},
        )
        write_manifest(self.path, first, [self.path])

    def estimated_bytes(self, first: Gaussians, frames: int) -> int:
        """Return how large the file will be; see `Output`."""
        return len(first) * 4 * (_FLOATS + 3 * first.harmonics.shape[1])

    def written_files(self) -> Sequence[Path]:
        """Return the files of the last pass."""
        return [self.path, manifest_path(self.path)]


def _write_glb(fourdgs: Any, gaussians: Gaussians, path: Path) -> None:
    count, harmonics_count = gaussians.harmonics.shape[:2]
    if not count:
        raise ExportError(
            f"{path.name}: expected at least one Gaussian, found none: there is nothing to show"
        )
    harmonics = gaussians.harmonics.numpy()
    higher = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, -1)
    steps = np.clip(np.round((higher + _REACH) / (2 * _REACH) * _STEPS), 0, _STEPS).astype(np.uint8)
    still, always = np.zeros((count, 3), np.float32), np.full(count, np.inf, np.float32)
    colors = np.concatenate(
        [harmonics[:, 0] * np.float32(C0) + np.float32(0.5), gaussians.opacities.numpy()[:, None]], 1
    )
    scene = fourdgs.GaussianSet(
        positions=gaussians.means.numpy(),
        scales=gaussians.scales.numpy(),
        rotations=gaussians.rotations.numpy()[:, [1, 2, 3, 0]],
        colors=colors,
        motions=still,
        mu_t=still[:, 0],
        sigma_t=always,
        win_lo=-always,
        win_hi=always,
        sh=steps if harmonics_count > 1 else None,
        sh_degree=round(harmonics_count**0.5) - 1,
    )
    fourdgs.to_gltf(
        str(path),
        scene,
        0.0,
        cutoff=0.05,
        coordinate_system="y-up-right-handed",
        color_space="srgb-rec709-display",
    )
