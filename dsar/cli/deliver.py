"""`dsar export` and `dsar render`."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dsar.cli.common import Common, capture_sequence, shown
from dsar.console import follow
from dsar.errors import ConfigError
from dsar.types import Camera, GaussianSequence, RenderOutput

if TYPE_CHECKING:
    from dsar_exporters import Output


@dataclass(frozen=True)
class Drive(Common):
    """Flags of commands that drive a trained avatar."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""
    motion: str = "test"
    """An AMASS/SMPL-X .npz or .bvh file, a sequence of the run's capture, or its split `test` or `train`."""
    frames: str | None = None
    """Frame numbers from 1001 on, e.g. 1001-1100x2; default: all."""

    def open(self) -> tuple[GaussianSequence, list[Camera], str]:
        """Return the rollout, the capture's cameras and the motion's name."""
        from dsar.avatar import roll_out
        from dsar.avatar.rollout import START_FRAME
        from dsar.data.capture import capture_of
        from dsar.data.motion import read_motion, resample
        from dsar.data.novelty import report_novelty
        from dsar.training.checkpoint import Run, load_checkpoint, newest_run
        from dsar_exporters import parse_frames

        self.check_device()
        run = Run(self.run_folder) if self.run_folder else newest_run()
        frames = None if self.frames is None else parse_frames(self.frames)
        avatar, config, provenance = load_checkpoint(run)
        capture = capture_of(config)
        name = capture_sequence(capture, self.motion)
        if name is not None:
            motion = capture.motions[name]
        else:
            motion = read_motion(Path(self.motion), avatar.body)
        if motion.fps != avatar.fps:
            motion = resample(motion, avatar.fps)
        if name is None:
            known = [capture.motions[trained] for trained in capture.splits["train"]]
            report_novelty(avatar.body, motion, known, START_FRAME)
        sequence = roll_out(avatar, motion, frames=frames, provenance=provenance)
        return sequence, list(capture.cameras), motion.name


@dataclass(frozen=True)
class Export(Drive):
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
    """Write nothing; say what is wrong with this file, whoever wrote it (USD, PLY or SPZ)."""

    def run(self) -> None:
        """Write every requested format from one rollout, or check a file."""
        if self.check is not None:
            self.run_check(self.check)
            return
        from dsar_exporters import export

        if not self.places():
            raise ConfigError(
                "dsar export: nothing to write; give --usd out.usda, --ply DIR, --compressed-ply DIR, "
                "--spz DIR, --glb FILE or --check FILE"
            )
        sequence, cameras, motion = self.open()
        outputs = self.outputs(cameras)
        delivered = export(shown(sequence, self.progress, "export"), list(outputs.values()))
        facts = {"gaussians": sequence.num_gaussians, "frames": len(sequence), "fps": sequence.fps}
        written = {name: str(output.path) for name, output in outputs.items()}
        files = {
            name: {"files": each.files, "bytes": each.size, "seconds": each.seconds}
            for name, each in zip(outputs, delivered, strict=True)
        }
        self.write_json({"motion": motion, "written": written, "cost": files, **facts})

    def places(self) -> list[Path]:
        """Return where something is to be written."""
        wanted = (self.usd, self.ply, self.compressed_ply, self.spz, self.glb)
        return [place for place in wanted if place is not None]

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


@dataclass(frozen=True)
class Render(Drive):
    """Drive an avatar with a motion and render image sequences."""

    exr: Path | None = None
    """Folder of EXR sequences: DIR/<camera>/<name>.<camera>.%04d.exr."""
    png: Path | None = None
    """Folder of PNG sequences with alpha."""
    mp4: Path | None = None
    """Video of the chosen cameras side by side, over white."""
    camera: str = "all"
    """A camera of the capture, or `all`."""
    res: tuple[int, int] | None = None
    """Width and height in pixels; default: the capture's."""
    colorspace: str = "lin_rec709_scene"
    """Scene-linear colour space of the EXRs (an OCIO name or interop id)."""
    name: str = "avatar"
    """Name in the files."""

    def run(self) -> None:
        """Render every chosen camera and write every requested format."""
        if self.exr is None and self.png is None and self.mp4 is None:
            raise ConfigError("dsar render: nothing to write; give --exr DIR, --png DIR or --mp4 FILE")
        sequence, cameras, motion = self.open()
        cameras = self.choose(cameras)
        images = 0
        for frame, camera, output in self.images(sequence, cameras):
            self.write(frame, camera, output, sequence)
            images += 1
        if self.mp4 is not None:
            self.write_video(sequence, cameras)
        self.write_json({"motion": motion, "images": images, "cameras": [c.name for c in cameras]})

    def choose(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Return the cameras to render, at the requested resolution."""
        names = [camera.name for camera in cameras]
        if self.camera != "all" and self.camera not in names:
            raise ConfigError(f"--camera {self.camera}: expected all or one of {', '.join(names)}")
        chosen = [camera for camera in cameras if self.camera in ("all", camera.name)]
        return [camera.resized(*self.res) if self.res else camera for camera in chosen]

    def images(
        self, sequence: GaussianSequence, cameras: list[Camera]
    ) -> Iterator[tuple[int, Camera, RenderOutput]]:
        """Yield the images for EXR and PNG, if any of them is wanted."""
        from dsar_render import render_sequence

        if self.exr is None and self.png is None:
            return iter(())
        made = render_sequence(sequence, cameras)
        return follow(made, len(sequence) * len(cameras), self.progress, "render")

    def write(self, frame: int, camera: Camera, output: RenderOutput, sequence: GaussianSequence) -> None:
        """Write one image in the requested formats."""
        from dsar_exporters import exr_path, write_exr
        from dsar_render import write_png

        if self.exr is not None:
            path = exr_path(self.exr, name=self.name, camera=camera.name, frame=frame)
            facts = {"fps": sequence.fps, "provenance": sequence.provenance, "colorspace": self.colorspace}
            write_exr(output, path, camera=camera, frame=frame, **facts)
        if self.png is not None:
            write_png(output, self.png / camera.name / f"{self.name}.{camera.name}.{frame:04d}.png")

    def write_video(self, sequence: GaussianSequence, cameras: list[Camera]) -> None:
        """Write the video of all chosen cameras side by side."""
        import numpy as np
        import torch

        from dsar_render import display_image, render_sequence, write_mp4

        assert self.mp4 is not None

        def rows() -> Iterator[np.ndarray]:
            row = []
            for _, _, output in render_sequence(sequence, cameras, background=torch.ones(3)):
                row.append(display_image(output))
                if len(row) == len(cameras):
                    yield np.concatenate(row, 1)
                    row = []

        write_mp4(follow(rows(), len(sequence), self.progress, "video"), self.mp4, fps=sequence.fps)
