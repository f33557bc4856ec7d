"""A shot: every frame of a rollout, from all cameras, into files; here, in processes, or on a cluster.

The rollout runs once, in the calling process, because a frame follows from the one before. A frame's pictures
depend on nothing but its Gaussians and those of the frames beside it, so they are made anywhere, and are the
same wherever they are made.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from dsar.geometry.camera_paths import CameraPath
from dsar.types import GaussianSequence
from dsar_render.camera_names import check_camera_names
from dsar_render.farm import run_tasks
from dsar_render.images import composite_over, crop_overscan, display_image
from dsar_render.job_hash import hash_job
from dsar_render.labels import Labels, label_sequence
from dsar_render.picture import render_picture
from dsar_render.settings import RenderSettings
from dsar_render.triplets import FrameTriplet, iterate_triplets
from dsar_render.writers import PictureWriter

Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Shot:
    """What is made of every frame."""

    paths: tuple[CameraPath, ...]
    """The cameras."""
    writers: tuple[PictureWriter, ...]
    """What the pictures become."""
    settings: RenderSettings = field(default_factory=RenderSettings)
    previews: bool = False
    """Whether frames are also wanted as images to look at, over white."""

    def __post_init__(self) -> None:
        """Check that there are cameras, each with a name of its own."""
        check_camera_names([path.name for path in self.paths])

    def job_hashes(self, frame: int, provenance: dict[str, str], writer: PictureWriter) -> list[str]:
        """Return the hash of all that each camera's file of a frame depends on."""
        key = writer.key
        return [hash_job(frame, path, self.settings, provenance, key) for path in self.paths]

    def is_complete(self, frame: int, provenance: dict[str, str]) -> bool:
        """Return whether all files of a frame are there, whole, and from this very shot."""
        names = [path.name for path in self.paths]
        return all(
            writer.is_complete(frame, names, self.job_hashes(frame, provenance, writer), self.settings.deep)
            for writer in self.writers
        )


def render_shot(
    shot: Shot,
    sequence: GaussianSequence,
    frames: Collection[int],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[int, Image | None]]:
    """Render frames and write their files; yield each frame's number when it is done, in order.

    With the number comes, if the shot has previews, an image of all cameras side by side.

    Args:
        shot: What is made of each.
        sequence: The rollout, with the frames beside those wanted if `shot.settings.needs_neighbours`.
        frames: Which to render.
        jobs: Processes that draw and write; 1: this one, beside its rollout.
        scheduler: Address of a Dask cluster that draws and writes instead, `tcp://HOST:PORT`.

    Raises:
        ConfigError: The sequence knows no body, and mattes of its parts are wanted; or the scheduler does not
            answer.
        RenderError: Workers died again and again.
    """
    labels = label_sequence(sequence) if "crypto" in shot.settings.aovs else None
    work = _FrameWork(
        shot.writers, shot.settings, shot.previews, labels, sequence.fps, dict(sequence.provenance)
    )
    triplets = iterate_triplets(sequence, frames, neighbours=shot.settings.needs_neighbours)
    tasks = (
        _FrameTask(triplet, tuple(path.around(triplet.frame) for path in shot.paths)) for triplet in triplets
    )
    return run_tasks(work, tasks, jobs=jobs, scheduler=scheduler)


@dataclass(frozen=True)
class _FrameTask:
    """A frame to draw."""

    triplet: FrameTriplet
    paths: tuple[CameraPath, ...]


@dataclass(frozen=True)
class _FrameWork:
    """Draws and writes a frame; the same for every task."""

    writers: tuple[PictureWriter, ...]
    settings: RenderSettings
    previews: bool
    labels: Labels | None
    fps: float
    provenance: dict[str, str]

    def __call__(self, task: _FrameTask) -> tuple[int, Image | None]:
        """Return the frame's number, and its preview."""
        views = [
            view for paths in self._batches(task.paths) for view in self._write_views(task.triplet, paths)
        ]
        return task.triplet.frame, np.concatenate(views, 1) if views else None

    def _batches(self, paths: tuple[CameraPath, ...]) -> list[tuple[CameraPath, ...]]:
        """Return which cameras' pictures are in memory at a time: one, unless cameras share a file."""
        return (
            [paths]
            if any(writer.combines_cameras for writer in self.writers)
            else [(path,) for path in paths]
        )

    def _write_views(self, triplet: FrameTriplet, paths: tuple[CameraPath, ...]) -> list[Image]:
        """Write what these cameras see, and return their previews, if the shot has any."""
        labels, fps, provenance = self.labels, self.fps, self.provenance
        pictures = [
            render_picture(triplet, path, self.settings, labels=labels, fps=fps, provenance=provenance)
            for path in paths
        ]
        shot = Shot(paths, self.writers, self.settings)
        for writer in self.writers:
            writer.write(pictures, shot.job_hashes(triplet.frame, provenance, writer))
        if not self.previews:
            return []
        return [display_image(composite_over(crop_overscan(picture), 1.0)) for picture in pictures]
