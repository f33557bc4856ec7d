"""`dsar crosscheck`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dsar.cli.command import GuardedCommand, file_stem, resolve_sequence
from dsar.console import ProgressBar
from dsar.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

    from dsar.data.captures.formats import MultiViewCapture
    from dsar.training.scene import Scene
    from dsar.types import Body, Gaussians
    from dsar_render.crosscheck import Shape

_PAGES = Path("runs/check")


@dataclass(frozen=True)
class Crosscheck(GuardedCommand):
    """Prove cameras, files and images of a run, or of a capture, by another renderer: Mitsuba."""

    capture: str | None = None
    """Check a capture alone, before training: its folder, `embedded` or `embedded-wool`."""
    body: Path | None = None
    """With --capture: SMPL-X model file (.npz, .pkl) or folder; default: its own, or $DSAR_BODY."""
    frame: int = 0
    """Frame of the test sequence whose pose is shown, from 0."""
    variant: str | None = None
    """Mitsuba's `llvm_ad_rgb` (needs libllvm19) or `scalar_rgb`; default: the first that works."""
    report: Path | None = None
    """The page; default: crosscheck.html in the run's folder, or runs/check/NAME.crosscheck.html."""

    def output_files(self) -> list[Path]:
        """Return the page, where it has a name already."""
        return [] if self.report is None else [self.report]

    def output_folders(self) -> list[Path]:
        """Return where a page goes that has none."""
        if self.report is not None:
            return []
        return [_PAGES if self.capture is not None else self.chosen_run()]

    def run(self) -> None:
        """Check, print, write the report; exit with 1 where something is wrong."""
        from dsar_exporters import read_back_projections
        from dsar_render.crosscheck import (
            cross_check,
            ellipsoids,
            load_mitsuba,
            write_crosscheck_report,
        )

        device = self.chosen_device()
        if self.run_folder is not None and self.capture is not None:
            raise ConfigError("dsar crosscheck: expected a run or --capture, found both: give one of them")
        if self.body is not None and self.capture is None:
            raise ConfigError("--body: expected with --capture; a run has its own")
        capture, body, drive, page = self.open(device)
        shapes = [self.posed(capture, body)]
        cameras = list(capture.cameras)
        projections = read_back_projections(cameras)
        mi = load_mitsuba(self.variant)
        gaussians = drive() if drive else None
        if gaussians is not None:
            shapes.append(ellipsoids(gaussians))
        with ProgressBar(self.progress, "crosscheck").running() as bar:
            verdict = cross_check(
                *(mi, cameras, projections, shapes, gaussians), lambda what, share: bar.show(share, what)
            )
        page = write_crosscheck_report(verdict, self.report or page)
        figures = verdict.figures.to_json()
        self.write_json(figures | {"report": str(page)})
        for key in ("camera_px_rms", "camera_px_max", "silhouette_iou", "depth_mae_m", "splat_psnr"):
            sys.stdout.write(f"{key}: {figures[key]}\n")
        for what, why in verdict.skipped.items():
            sys.stdout.write(f"{what} not checked: {why}\n")
        for fault in verdict.faults:
            sys.stdout.write(f"WRONG {fault}\n")
        sys.stdout.write(
            f"seeded mistakes caught: {len(verdict.caught)} of {len(verdict.seeds)}; look at {page}\n"
        )
        if not verdict.passed:
            raise SystemExit(1)

    def open(
        self, device: "torch.device"
    ) -> "tuple[MultiViewCapture | Scene, Body, Callable[[], Gaussians] | None, Path]":
        """Return cameras and motions, the body, what makes a run's Gaussians of the frame, and the page."""
        from dsar.avatar import roll_out
        from dsar.avatar.rollout import START_FRAME
        from dsar.data.captures.formats import open_capture
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_scene

        if self.capture is not None:
            capture = open_capture(self.capture, body=self.body)
            return capture, capture.body, None, _PAGES / f"{file_stem(capture.name)}.crosscheck.html"
        run = Run(self.chosen_run())
        avatar, config, _ = load_checkpoint(run, device)
        scene = open_scene(run, config)
        self.guard(run, avatar, lambda: scene)
        motion = scene.motions[self.sequence(scene)]

        def drive() -> "Gaussians":
            frames = roll_out(avatar, motion, frames=[START_FRAME + self.frame]).in_main_memory()
            return next(iter(frames))[1].detach()

        return scene, avatar.body.to(device="cpu"), drive, run.folder / "crosscheck.html"

    def sequence(self, capture: "MultiViewCapture | Scene") -> str:
        """Return the sequence whose pose is shown; check that it has the frame."""
        name = next(iter(capture.motions))
        if capture.splits.get("test"):
            name = resolve_sequence(capture, "test") or name
        length = len(capture.motions[name])
        if not 0 <= self.frame < length:
            raise ConfigError(
                f"--frame {self.frame}: expected 0 to {length - 1}, the frames of sequence {name}"
            )
        return name

    def posed(self, capture: "MultiViewCapture | Scene", body: "Body") -> "Shape":
        """Return the body in the frame's pose."""
        from dsar.body.skinning import pose_vertices
        from dsar_render.crosscheck import Shape

        motion = capture.motions[self.sequence(capture)]
        return Shape("body", pose_vertices(body, motion[self.frame]), body.faces)
