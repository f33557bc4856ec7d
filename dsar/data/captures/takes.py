"""From takes to a capture: upright, with a part of them held out."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.body.files import choose_body, load_body
from dsar.data.captures.multiview import MultiViewCapture, Views
from dsar.data.captures.splits import split_takes
from dsar.data.motions.files import rotate_motion
from dsar.data.motions.mmd import label_sequences
from dsar.data.motions.up_axis import rotation_to_y_up
from dsar.errors import CaptureError
from dsar.geometry.camera_checks import check_names_differ
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Body, Camera, Motion

_UPRIGHT = 0.7
LOGGER = logging.getLogger(__name__)


@runtime_checkable
class ViewFiles(Views, Protocol):
    """Images that say where their files should be."""

    def expected_files(self, camera: Camera) -> str:
        """Return where a camera's first image should be, in words."""
        ...

    def check_samples(self, cameras: Sequence[Camera]) -> None:
        """Look at some images of each camera, log what is converted, or raise CaptureError."""
        ...


@dataclass(frozen=True)
class Take:
    """What was filmed in one go."""

    motion: Motion
    """In the calibration's world, whichever way is up."""
    views: ViewFiles
    """Its images."""


@dataclass(frozen=True)
class OpenOptions:
    """How a user wants a capture opened."""

    body: Path | None = None
    """Body-model file, or a folder of SMPLX_<GENDER> files; None: the capture's own, or $DSAR_BODY if its
    format brings none."""
    train_frames: str | None = None
    """Frames that train, such as 0-239: of a single take, or of each training take."""
    test_frames: str | None = None
    """Frames that test."""


def make_capture(
    root: Path,
    name: str,
    cameras: Sequence[Camera],
    takes: Sequence[Take],
    options: OpenOptions,
    reopen: Callable[[], MultiViewCapture],
    *,
    betas: Float[Tensor, " s"],
    gender: str = "neutral",
) -> MultiViewCapture:
    """Return a capture with Y up, of which the last third is held out.

    Args:
        root: Its folder.
        name: Its label.
        cameras: In the calibration's world.
        takes: At one frame rate.
        options: The user's wishes.
        reopen: Opens the same capture again.
        betas: The shape with which the motion was fitted.
        gender: The body model with which it was.

    Raises:
        CaptureError: nothing is left to train with, or images are missing altogether.
        BodyError: the body file is not usable.
    """
    check_names_differ(f"capture {root}", [camera.name for camera in cameras], CaptureError)
    body, path = fitted_body(str(root), options.body, betas, gender)
    R_world_file = rotation_to_upright(str(root), [take.motion for take in takes])
    cameras = [rotate_camera_world(camera, R_world_file) for camera in cameras]
    for take in takes:
        _count_images(f"capture {root}, {take.motion.name}", cameras, take)
        take.views.check_samples(cameras)
    by_name = {take.motion.name: take for take in takes}
    lengths = {name: len(take.motion) for name, take in by_name.items()}
    sequences = split_takes(f"capture {root}", lengths, options.train_frames, options.test_frames)
    splits = {split: tuple(members) for split, members in sequences.items()}
    motions, starts, views = {}, {}, {}
    for key, (take, frames) in (sequences["train"] | sequences["test"]).items():
        motion = by_name[take].motion.slice(frames.start, frames.stop)
        motions[key] = dataclasses.replace(rotate_motion(motion, body, R_world_file), name=key)
        starts[key], views[key] = frames.start, by_name[take].views
    return MultiViewCapture(
        root=root,
        name=name,
        fps=takes[0].motion.fps,
        cameras=cameras,
        body=body,
        body_path=path,
        betas=betas if path else torch.zeros(0),
        motions=motions,
        splits=splits | label_sequences(motions, splits),
        views=views,
        starts=starts,
        R_world_file=R_world_file,
        backdrop=True,
        reopen=reopen,
    )


def fitted_body(
    name: str, path: Path | None, betas: Float[Tensor, " s"], gender: str
) -> tuple[Body, Path | None]:
    """Return the body with which a motion was fitted, and its file; else the embedded one, and warn."""
    body_file = choose_body(path, gender)
    if body_file is None:
        LOGGER.warning(
            "Capture %s was fitted with a %s SMPL-X body, which needs a licence: the embedded body, which is "
            "another, takes its place and will be centimetres off. Give SMPL-X's file with --body or in "
            "$DSAR_BODY",
            *(name, gender),
        )
        return load_body(), None
    return load_body(body_file, betas), body_file


def rotation_to_upright(name: str, motions: Sequence[Motion]) -> Float[Tensor, "3 3"]:
    """Return R_world_file, by quarter turns, that puts +Y where the bodies' heads mostly are."""
    roots = torch.cat([matrix_from_axis_angle(motion.rotations[:, 0]) for motion in motions])
    up = roots[:, :, 1].mean(0)
    axis = int(up.abs().argmax())
    if up.abs()[axis] < _UPRIGHT:
        raise CaptureError(
            f"capture {name}: which way is up? On average the body's spine points along {up.tolist()}, along "
            "no axis of the calibration's world; turn calibration and motion so that Y is up"
        )
    return rotation_to_y_up(("-" if up[axis] < 0 else "") + "xyz"[axis])


def rotate_camera_world(camera: Camera, R_world_file: Float[Tensor, "3 3"]) -> Camera:
    """Return the same camera in a rotated world."""
    transform = camera.T_camera_world.clone()
    transform[:3, :3] = transform[:3, :3] @ R_world_file.T
    return dataclasses.replace(camera, T_camera_world=transform)


def _count_images(where: str, cameras: Sequence[Camera], take: Take) -> None:
    """Raise where a camera saw nothing; log how many frames the others lack."""
    frames, lacks = range(len(take.motion)), {}
    for camera in cameras:
        lacks[camera.name] = sum(not take.views.has(camera, frame) for frame in frames)
        if lacks[camera.name] == len(frames):
            expected = take.views.expected_files(camera)
            raise CaptureError(f"{where}: {camera.name} has no image with a mask; expected {expected}")
    if any(lacks.values()):
        listed = ", ".join(f"{name} {count}" for name, count in lacks.items() if count)
        LOGGER.warning("%s: images are missing, and done without: %s of %d", where, listed, len(frames))
