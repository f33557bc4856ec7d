"""A capture as every reader presents it: cameras, images by sequence, body, motion and splits."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dsar.data.images.decoding import CACHE_BYTES
from dsar.errors import CaptureError, ConfigError
from dsar.geometry.cameras import farthest_cameras
from dsar.geometry.frame_numbers import parse_frame_range
from dsar.types import Body, Camera, Motion

FILMED_SPLITS = ("train", "test")
"""Splits of sequences with images."""
UNSEEN_SPLITS = ("unseen_validation", "unseen_test")
"""Splits of unseen motions: never trained on, without images, with the garment's truth. The first is for
choosing between methods, the second is only ever reported."""


@runtime_checkable
class Views(Protocol):
    """The images of one sequence."""

    def has(self, camera: Camera, frame: int) -> bool:
        """Return whether there is such an image, with its mask."""
        ...

    def read(self, camera: Camera, frame: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return an image: straight sRGB, and the mask as alpha.

        Raises:
            CaptureError: It is not there, cannot be decoded or has the wrong size.
        """
        ...


@runtime_checkable
class LabelledViews(Views, Protocol):
    """Images with labels."""

    def garment_mask(self, camera: Camera, frame: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where an image shows loose garments; None where there are no labels of it.

        Raises:
            CaptureError: They cannot be read.
        """
        ...


@dataclass(frozen=True)
class OneToMany:
    """Frames of one sequence in which the body's pose is the same and the cloth is not; ends included."""

    sequence: str
    after_stop: tuple[int, int]
    at_rest: tuple[int, int]

    def within(self, frames: range) -> "OneToMany | None":
        """Return the same counted from the first of some frames; None where they do not hold it all."""
        ends = (*self.after_stop, *self.at_rest)
        if not len(frames) or min(ends) < frames.start or max(ends) >= frames.stop:
            return None
        a, b, c, d = (end - frames.start for end in ends)
        return OneToMany(self.sequence, (a, b), (c, d))


@dataclass(frozen=True)
class MultiViewCapture:
    """Multi-view video of one dressed person; implements `dsar.types.Capture`.

    Images are decoded on demand. Pickling sends only how to open the capture; the other process opens it.
    """

    root: Path
    """The capture's folder."""
    name: str
    """Label of the capture."""
    fps: float
    """Frames per second of every sequence."""
    cameras: Sequence[Camera]
    """Calibrated cameras, the same for every frame."""
    body: Body
    """The person at rest, in the capture's shape."""
    body_path: Path | None
    """The body-model file; None is the embedded body."""
    betas: Float[Tensor, " s"]
    """Shape coefficients of the body."""
    motions: Mapping[str, Motion]
    """Body motion of each sequence, by sequence name."""
    splits: Mapping[str, Sequence[str]]
    """Sequence names of `train` and `test`, of each label such as `nd`, `fd`, and of `unseen_validation` and
    `unseen_test` where there are unseen motions."""
    views: Mapping[str, Views] = field(repr=False)
    """The images of each sequence; unseen motions have none."""
    reopen: Callable[[], "MultiViewCapture"] = field(repr=False)
    """Opens the same folder in the same way, all cameras; survives pickling."""
    one_to_many: Sequence[OneToMany] = ()
    """Where equal poses with different cloth are to be found."""
    garments: Mapping[str, Path] = field(default_factory=dict, repr=False)
    """Files of the garment's true vertices, of the sequences that have one."""
    starts: Mapping[str, int] = field(default_factory=dict)
    """Which frame of its images is a sequence's first, where that is not 0."""
    backdrop: bool = False
    """Whether images are photographs, with colours outside the masks, and kept once they were decoded."""
    R_world_file: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3))
    """Rotation from the world of the capture's files to ours, in which Y is up."""

    def __reduce__(self) -> tuple[Callable[..., "MultiViewCapture"], tuple]:
        return _reopen, (self.reopen, tuple(camera.name for camera in self.cameras))

    @property
    def kept_bytes(self) -> int:
        """Bytes of decoded images that a process keeps at most, while it reads this capture."""
        if not self.backdrop:
            return 0
        pixels = sum(camera.width * camera.height for camera in self.cameras)
        frames = sum(len(motion) for name, motion in self.motions.items() if name in self.views)
        return min(CACHE_BYTES, 4 * pixels * frames)

    def with_cameras(self, count: int | None) -> "MultiViewCapture":
        """Return the capture as seen by some of its cameras, spread as far as can be; None: by all."""
        if count is None:
            return self
        if not 1 <= count <= len(self.cameras):
            raise ConfigError(f"cameras is {count}; capture {self.name} has {len(self.cameras)}")
        return dataclasses.replace(self, cameras=farthest_cameras(self.cameras, count))

    def with_frames(self, train: str | None, test: str | None) -> "MultiViewCapture":
        """Return the capture with some frames of each training and each test sequence only; None: with all.

        Unseen motions stay whole.

        Raises:
            ConfigError: a range is not of the form 0-239.
            CaptureError: no frames are left to train with, or to test.
        """
        if train is None and test is None:
            return self
        chosen = {
            name: parse_frame_range(text, len(self.motions[name]))
            for split, text in (("train", train), ("test", test))
            for name in self.splits[split]
        }
        chosen |= {
            name: range(len(self.motions[name]))
            for split in UNSEEN_SPLITS
            for name in self.splits.get(split, ())
        }
        chosen = {name: frames for name, frames in chosen.items() if len(frames)}
        splits = {
            split: tuple(name for name in names if name in chosen) for split, names in self.splits.items()
        }
        for split, text in (("train", train), ("test", test)):
            if not splits[split]:
                raise CaptureError(
                    f"capture {self.name}: no frames of {split} sequences are in {text or 'any'}; "
                    f"the longest has {max(map(len, self.motions.values()))}"
                )
        pairs = (pair.within(chosen.get(pair.sequence, range(0))) for pair in self.one_to_many)
        return dataclasses.replace(
            self,
            motions={name: self.motions[name].slice(r.start, r.stop) for name, r in chosen.items()},
            starts={name: self.starts.get(name, 0) + frames.start for name, frames in chosen.items()},
            splits=splits,
            one_to_many=tuple(pair for pair in pairs if pair is not None),
            reopen=partial(_narrow, self.reopen, train, test),
        )

    def cameras_with_image(self, sequence: str, frame: int) -> list[int]:
        """Return the cameras that have an image of a frame with its mask; none of an unseen motion."""
        if sequence not in self.views:
            return []
        views, number = self.views[sequence], frame + self.starts.get(sequence, 0)
        return [index for index, camera in enumerate(self.cameras) if views.has(camera, number)]

    def image(self, sequence: str, frame: int, camera: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return one image: straight (not premultiplied) sRGB and coverage as alpha.

        Raises:
            CaptureError: There is no such image, or it cannot be decoded or has the wrong size.
        """
        if sequence not in self.motions:
            raise CaptureError(
                f"capture {self.name}: no sequence {sequence!r}; there are {', '.join(self.motions)}"
            )
        view, frames = self.cameras[camera], len(self.motions[sequence])
        if not 0 <= frame < frames:
            raise CaptureError(
                f"capture {self.name}, {sequence}: no frame {frame}; there are 0 to {frames - 1}"
            )
        if sequence not in self.views:
            raise CaptureError(f"capture {self.name}, {sequence}: an unseen motion has no images")
        return self.views[sequence].read(view, frame + self.starts.get(sequence, 0))

    def garment_mask(self, sequence: str, frame: int, camera: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where an image shows loose garments, by the capture's own labels; None without any.

        Raises:
            CaptureError: The labels cannot be read.
        """
        views = self.views.get(sequence)
        if not isinstance(views, LabelledViews):
            return None
        return views.garment_mask(self.cameras[camera], frame + self.starts.get(sequence, 0))

    def garment(self, sequence: str, run: int = 0) -> Float[np.ndarray, "f v 3"]:
        """Return the simulated garment's true vertices, world metres.

        Args:
            sequence: Name of a sequence with garment truth.
            run: 0 is the run in the images; higher ones are other true outcomes of the same motion, begun
                from a slightly different state.

        Raises:
            CaptureError: The capture has no such truth.
        """
        steps = self._read_garment(sequence, f"run{run}")
        unit = self._read_garment(sequence, "unit")
        places = (np.cumsum(steps.astype(np.int32), 0) * float(unit)).astype(np.float32)
        start = self.starts.get(sequence, 0)
        return places[start : start + len(self.motions[sequence])]

    def garment_runs(self, sequence: str) -> int:
        """Return how many true outcomes of a sequence `garment` knows; 0 without garment truth."""
        path = self.garments.get(sequence)
        if path is None:
            return 0
        with np.load(path) as file:
            return sum(key.startswith("run") for key in file.files)

    def garment_faces(self, sequence: str) -> Int[np.ndarray, "t 3"]:
        """Return the triangles of the garment's vertices, counter-clockwise seen from outside."""
        return self._read_garment(sequence, "faces").astype(np.int64)

    def _read_garment(self, sequence: str, key: str) -> np.ndarray:
        path = self.garments.get(sequence)
        if path is None:
            known = ", ".join(self.garments) or "none"
            raise CaptureError(f"capture {self.name}: no garment truth for {sequence!r}; it has {known}")
        with np.load(path) as file:
            if key not in file.files:
                raise CaptureError(f"garment {path}: expected {key}, found {', '.join(file.files)}")
            return file[key]


def _narrow(reopen: Callable[[], MultiViewCapture], train: str | None, test: str | None) -> MultiViewCapture:
    return reopen().with_frames(train, test)


def _reopen(reopen: Callable[[], MultiViewCapture], cameras: tuple[str, ...]) -> MultiViewCapture:
    """Return a capture as seen by the cameras of these names."""
    capture = reopen()
    return dataclasses.replace(capture, cameras=[c for c in capture.cameras if c.name in cameras])
