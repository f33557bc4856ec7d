"""What a person looks at first: sheets of held-out views, a video beside the truth, the report."""

import importlib.util
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsar.cli.command import resolve_sequence

if TYPE_CHECKING:
    import torch

    from dsar.evaluation.results import WorstView

_log = logging.getLogger(__name__)
_COLUMNS = 10
"""Frames of a contact sheet."""


def write_previews(folder: Path, device: "torch.device") -> Path:
    """Write the contact sheet, the video and the report of a run; return the sheet's path.

    Rollouts are computed on a device.
    """
    from dsar.evaluation.report import write_report
    from dsar.training.checkpoint import Run

    sheet = write_contact_sheet(folder, device)
    if importlib.util.find_spec("imageio_ffmpeg"):
        write_comparison(folder, device)
    else:
        _log.info('No compare.mp4: package imageio-ffmpeg is missing, pip install "dsar-avatar[video]"')
    write_report(Run(folder))
    return sheet


def write_contact_sheet(folder: Path, device: "torch.device") -> Path:
    """Write truth above prediction for some frames and cameras of the run's test motion."""
    from dsar_render import write_contact_sheet

    scene = _Scene(folder, device)
    last = len(scene.capture.motions[scene.far]) - 1
    frames = sorted({round(i * last / (_COLUMNS - 1)) for i in range(_COLUMNS)})
    rows: dict[str, list] = {}
    for camera in scene.some_cameras():
        name = scene.capture.cameras[camera].name
        rows[f"{name} truth"] = [scene.truth(scene.far, frame, camera) for frame in frames]
        rows[f"{name} dsar"] = []
    for _, camera, image in scene.images(scene.far, frames, scene.some_cameras()):
        rows[f"{scene.capture.cameras[camera].name} dsar"].append(image)
    columns = [f"{scene.far} {scene.first + frame}" for frame in frames]
    return write_contact_sheet(folder / "previews" / "sheet.png", rows, columns=columns)


def write_comparison(folder: Path, device: "torch.device") -> Path:
    """Write a video of the run's test motion, truth and avatar in turn, seen by some cameras."""
    import numpy as np

    from dsar_render import write_mp4

    scene = _Scene(folder, device)
    motion, cameras = scene.capture.motions[scene.far], scene.some_cameras()[:2]

    def pictures() -> Iterator[np.ndarray]:
        row = []
        for frame, camera, image in scene.images(scene.far, range(len(motion)), cameras):
            row += [scene.truth(scene.far, frame, camera), image]
            if camera == cameras[-1]:
                yield np.concatenate(row, 1)
                row = []

    path = folder / "previews" / "compare.mp4"
    write_mp4(pictures(), path, fps=motion.fps)
    return path


def write_worst(folder: Path, views: "Sequence[WorstView]", device: "torch.device") -> Path:
    """Write truth above prediction for views of held-out sequences."""
    from dsar_render import write_contact_sheet

    scene, pairs = _Scene(folder, device), {}
    for name in dict.fromkeys(view.sequence for view in views):
        wanted = {(view.frame, view.camera) for view in views if view.sequence == name}
        frames, cameras = (sorted({pair[axis] for pair in wanted}) for axis in (0, 1))
        for frame, camera, image in scene.images(name, frames, cameras):
            if (frame, camera) in wanted:
                pairs[name, frame, camera] = (scene.truth(name, frame, camera), image)
    order = [(view.sequence, view.frame, view.camera) for view in views]
    rows = {who: [pairs[view][i] for view in order] for i, who in enumerate(("truth", "dsar"))}
    columns = [
        f"{name} {scene.first + frame} {scene.capture.cameras[camera].name}" for name, frame, camera in order
    ]
    return write_contact_sheet(folder / "previews" / "worst.png", rows, columns=columns)


class _Scene:
    """A run's avatar and its capture, and images of both as they are shown: over white, 8 bits."""

    def __init__(self, folder: Path, device: "torch.device") -> None:
        from dsar.avatar.rollout import START_FRAME
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_images

        run = Run(folder)
        self.avatar, config, _ = load_checkpoint(run, device)
        self.capture, self.first = open_images(run, config), START_FRAME
        self.far = resolve_sequence(self.capture, "test") or ""

    def some_cameras(self) -> list[int]:
        """Return three cameras, a third of the ring apart where they stand in one."""
        count = len(self.capture.cameras)
        return sorted({0, count // 3, 2 * count // 3})

    def truth(self, sequence: str, frame: int, camera: int) -> Any:
        """Return a true image; white where the camera has none."""
        import numpy as np

        from dsar.evaluation.views import to_bytes, true_view

        if camera not in self.capture.cameras_with_image(sequence, frame):
            view = self.capture.cameras[camera]
            return np.full((view.height, view.width, 3), 255, np.uint8)
        return to_bytes(true_view(self.capture, sequence, frame, camera).color)

    def images(
        self, sequence: str, frames: Sequence[int], cameras: Sequence[int]
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield frame, camera and image of the avatar's rollout, camera by camera in each frame."""
        import torch

        from dsar.avatar import roll_out
        from dsar_render import display_image, render_sequence

        numbers = [self.first + frame for frame in frames]
        motion = self.capture.motions[sequence]
        chosen = [self.capture.cameras[camera] for camera in cameras]
        rollout = roll_out(self.avatar, motion, frames=numbers).in_main_memory()
        rendered = render_sequence(rollout, chosen, background=torch.ones(3))
        index = {camera.name: number for number, camera in zip(cameras, chosen, strict=True)}
        for number, camera, output in rendered:
            yield number - self.first, index[camera.name], display_image(output)
