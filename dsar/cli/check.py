"""`dsar check`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from dsar.cli.command import Common, file_stem
from dsar.config import PRESETS
from dsar.console import ProgressBar

if TYPE_CHECKING:
    from dsar.types import Camera

_MINUTES = 60.0
_SHEETS = Path("runs/check")


@dataclass(frozen=True)
class Check(Common):
    """Read a capture, lay the body over its images, and say what is wrong with it and how to mend it."""

    capture: tyro.conf.Positional[str] = "embedded"
    """A capture folder in any supported format, `embedded` or `embedded-wool`."""
    body: Path | None = None
    """SMPL-X model file (.npz, .pkl), or a folder of them; default: the capture's own, or $DSAR_BODY."""
    train_frames: str | None = None
    """Frames that train, e.g. 0-239, as in `dsar train`."""
    test_frames: str | None = None
    """Frames that test."""
    sheet: Path | None = None
    """PNG of the body over the images; default runs/check/NAME.png."""

    def output_files(self) -> list[Path]:
        """Return the sheet, where it has a name already."""
        return [] if self.sheet is None else [self.sheet]

    def output_folders(self) -> list[Path]:
        """Return where a sheet goes that has none."""
        return [_SHEETS] if self.sheet is None else []

    def run(self) -> None:
        """Check, print, write the sheet; exit with 2 where the capture cannot train."""
        from dsar.data.captures.formats import open_capture
        from dsar.evaluation.check import check_capture, draw_overlays
        from dsar_render import write_contact_sheet

        self.chosen_device()
        capture = open_capture(
            self.capture, body=self.body, train_frames=self.train_frames, test_frames=self.test_frames
        )
        with ProgressBar(self.progress, "check").running() as bar:
            verdict = check_capture(capture, lambda what, share: bar.show(share, what))
        rows, columns = draw_overlays(capture)
        sheet = write_contact_sheet(
            self.sheet or _SHEETS / f"{file_stem(capture.name)}.png",
            rows,
            columns=columns,
        )
        needs = self.estimate(capture.cameras)
        self.write_json(verdict.to_json() | {"sheet": str(sheet), "demo_preset": needs})
        for camera in verdict.cameras:
            shares = (
                f"{camera.inside:6.1%} of the body in the mask, IoU {camera.iou:.2f}"
                if camera.inside is not None and camera.iou is not None
                else "no image to compare"
            )
            sys.stdout.write(
                f"{camera.name:16s} {camera.images} images, {camera.missing} missing, {shares}\n"
            )
        for key, value in verdict.to_json()["figures"].items():
            sys.stdout.write(f"{key}: {value}\n")
        sys.stdout.write(
            f"training with the demo's preset: {needs['worker_bytes'] / 2**30:.1f} GiB a worker, and "
            f"{needs['minutes_at_least']:.0f} minutes or more\n"
        )
        for finding in verdict.findings:
            sys.stdout.write(
                f"{'CANNOT TRAIN' if finding.fatal else 'WRONG'} {finding.name}: {finding.what}\n"
            )
        sys.stdout.write(f"{'nothing is wrong' if not verdict.findings else 'see above'}; look at {sheet}\n")
        if verdict.fatal:
            raise SystemExit(2)

    def estimate(self, cameras: "Sequence[Camera]") -> dict[str, Any]:
        """Return what training with the demo's preset would need on this machine, on whole images."""
        import torch

        from dsar.training.budget import estimate
        from dsar.training.device_rates import measure_rates

        config = PRESETS["demo"]
        view = max(camera.height for camera in cameras), max(camera.width for camera in cameras)
        budget = estimate(config, view)
        rate = measure_rates(torch.device("cpu")).convolution
        seconds = budget.cost.network_flop / rate * config.schedule.steps
        return {"worker_bytes": budget.memory, "minutes_at_least": seconds / _MINUTES}
