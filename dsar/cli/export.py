"""`dsar export`."""

import dataclasses
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dsar.cli.command import with_progress
from dsar.cli.drive_command import DriveCommand, DrivenAvatar
from dsar.errors import CheckpointError, ConfigError
from dsar.types import Camera

if TYPE_CHECKING:
    from dsar_exporters import Output

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class WritingCost:
    """What an output took."""

    files: int
    bytes: int
    seconds: float
    """Spent in writing, without the rollout."""


@dataclass(frozen=True)
class ExportFacts:
    """What was written; the fields are the keys of `dsar export --json`."""

    motion: str
    """Name of the motion."""
    written: Mapping[str, str]
    """Path by the name of the output's flag."""
    cost: Mapping[str, WritingCost]
    """By the same names."""
    gaussians: int
    frames: int
    fps: float
    """Frames per second of the frame numbers."""


@dataclass(frozen=True)
class Export(DriveCommand):
    """Drive an avatar with a motion and write the Gaussians of each frame."""

    usd: Path | None = None
    """USD asset: .usda or .usdc."""
    ply: Path | None = None
    """Folder of 3DGS splat files, one per frame."""
    compressed_ply: Path | None = None
    """Folder of PlayCanvas's compressed PLY files, one per frame."""
    spz: Path | None = None
    """Folder of SPZ files, one per frame."""
    glb: Path | None = None
    """glTF file with KHR_gaussian_splatting: the first frame."""
    half: bool = False
    """USD: write splats in 16 bits where that is enough (not positions)."""
    clips: bool = False
    """USD: one value clip a frame, for shots of many gigabytes."""
    sh_degree: int | None = None
    """PLY: pad the harmonics with zeros to this degree, for viewers that insist on one."""
    name: str = "avatar"
    """Name of the asset and of the files."""
    check: Path | None = None
    """Write nothing; say what is wrong with this file, whoever wrote it (USD, PLY, SPZ or GLB)."""

    def output_files(self) -> list[Path]:
        """Return the files of a name of their own."""
        return [path for path in (self.usd, self.glb) if path is not None]

    def output_folders(self) -> list[Path]:
        """Return the folders of sequences."""
        return [path for path in (self.ply, self.compressed_ply, self.spz) if path is not None]

    def describe_remains(self) -> str:
        """Return what is left."""
        return "no file is half written; of splat sequences the frames that were finished stay"

    def run(self) -> None:
        """Write every requested format from one rollout, or check a file."""
        if self.check is not None:
            self.run_check(self.check)
            return
        from dsar_exporters import export

        if not self.output_files() and not self.output_folders():
            raise ConfigError(
                "dsar export: nothing to write; give --usd out.usda, --ply DIR, --compressed-ply DIR, "
                "--spz DIR, --glb FILE or --check FILE"
            )
        self.check_name(self.name)
        wanted = self.requested_frames()
        driven = self.open()
        sequence = driven.roll_out(wanted)
        outputs = self.outputs(self.cameras(driven))
        delivered = export(with_progress(sequence, self.progress, "export"), list(outputs.values()))
        deliveries = dict(zip(outputs, delivered, strict=True))
        facts = ExportFacts(
            motion=driven.motion.name,
            written={name: str(output.path) for name, output in outputs.items()},
            cost={
                name: WritingCost(files=delivery.files, bytes=delivery.size, seconds=delivery.seconds)
                for name, delivery in deliveries.items()
            },
            gaussians=sequence.num_gaussians,
            frames=len(sequence),
            fps=sequence.fps,
        )
        self.write_json(dataclasses.asdict(facts))

    def cameras(self, driven: DrivenAvatar) -> Sequence[Camera]:
        """Return the capture's cameras for formats that have cameras; none, and say so, if they are gone."""
        if self.usd is None:
            return ()
        try:
            return driven.cameras
        except CheckpointError as error:
            LOGGER.warning("--usd %s: of all cameras it has the turntable alone: %s", self.usd, error)
            return ()

    def outputs(self, cameras: Sequence[Camera]) -> "dict[str, Output]":
        """Return the requested formats by the name of their flag."""
        from dsar_exporters import CompressedPlySequence, GltfSnapshot, PlySequence, SpzSequence, UsdAsset

        wanted: dict[str, Output] = {}
        if self.usd is not None:
            wanted["usd"] = UsdAsset(self.usd, self.name, cameras=cameras, half=self.half, clips=self.clips)
        if self.ply is not None:
            wanted["ply"] = PlySequence(self.ply, self.name, sh_degree=self.sh_degree)
        if self.compressed_ply is not None:
            wanted["compressed_ply"] = CompressedPlySequence(self.compressed_ply, self.name)
        if self.spz is not None:
            wanted["spz"] = SpzSequence(self.spz, self.name)
        if self.glb is not None:
            wanted["glb"] = GltfSnapshot(self.glb)
        return wanted

    def run_check(self, path: Path) -> None:
        """Print what is wrong with a file; exit with 2 where something is."""
        from dsar_exporters import find_faults

        faults = find_faults(path)
        self.write_json({"file": str(path), "faults": faults})
        for fault in faults:
            sys.stdout.write(f"WRONG {fault}\n")
        sys.stdout.write(f"{path}: {len(faults) or 'no'} fault{'s' if len(faults) != 1 else ''}\n")
        if faults:
            raise SystemExit(2)
