"""How well a posed body and the masks agree: the measure by which mistakes in a capture are found."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.body.model import FACE_JOINTS, JOINT_NAMES
from dsar.body.skinning import forward_kinematics, pose_vertices
from dsar.data.captures.multiview import MultiViewCapture
from dsar.geometry.cameras import project
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Body, Camera, Motion

COARSE, FINE = 256, 1024
"""Pixels of height to which larger images are reduced, to look for coarse and for fine mistakes."""
_FRAMES = 8
_SAMPLES = 512
_HANDS = (slice(FACE_JOINTS.stop, FACE_JOINTS.stop + 15), slice(FACE_JOINTS.stop + 15, len(JOINT_NAMES)))
_REACH = 0.06
"""Metres of a hand's last joints to its finger tips, and some more."""
_CLOTHES = 0.25
"""What a pixel of clothes that no body fills counts, beside one of the body outside the mask: 1."""


@dataclass(frozen=True)
class Hypothesis:
    """What a capture says of where the body is: this is right or wrong, its masks are taken as they are."""

    cameras: Mapping[int, Camera]
    """By index in the capture."""
    motions: Mapping[str, Motion]
    """By sequence."""
    body: Body
    """The person at rest."""

    @cached_property
    def _posed(self) -> dict[tuple[str, int], Float[Tensor, "v 3"]]:
        return {}

    def vertices(self, sequence: str, frame: int) -> Float[Tensor, "v 3"]:
        """Return the body in a frame, or in the nearest one that the motion has, world metres."""
        motion = self.motions[sequence]
        frame = min(max(frame, 0), len(motion) - 1)
        if (sequence, frame) not in self._posed:
            self._posed[sequence, frame] = pose_vertices(self.body, motion[frame])
        return self._posed[sequence, frame]


@dataclass(frozen=True)
class Mask:
    """One view's mask, and the camera of its pixels."""

    sequence: str
    frame: int
    camera: int
    """Index in the capture."""
    alpha: Float[Tensor, "h w"]
    """Share of each pixel that the person covers."""
    reduction: int
    """Pixels of the image that make one of these, each way."""
    corner: tuple[int, int] = (0, 0)
    """Column and row of the reduced image at which this part of it begins."""

    def at_mask_resolution(self, camera: Camera) -> Camera:
        """Return a camera of this view at the mask's resolution."""
        width, height = camera.width // self.reduction, camera.height // self.reduction
        whole = dataclasses.replace(camera, width=width * self.reduction, height=height * self.reduction)
        return whole.resized(width, height).cropped(*self.corner, *reversed(self.alpha.shape))

    def part(self, x0: int, y0: int, x1: int, y1: int) -> "Mask":
        """Return columns x0 to x1-1 and rows y0 to y1-1."""
        left, top = self.corner
        return dataclasses.replace(self, alpha=self.alpha[y0:y1, x0:x1], corner=(left + x0, top + y0))


@dataclass(frozen=True)
class SilhouetteAgreement:
    """One view's body against its mask."""

    inside: float
    """Share of the body's silhouette in the mask; 0 where no camera sees the body."""
    iou: float
    """Intersection over union of both."""
    error: float
    """Area of the body outside the mask, and a quarter of the mask's outside the body, by the mask's area."""


def read(capture: MultiViewCapture) -> Hypothesis:
    """Return what a capture says."""
    return Hypothesis(dict(enumerate(capture.cameras)), capture.motions, capture.body)


def load_masks(
    capture: MultiViewCapture,
    usable: Collection[tuple[str, int, int]],
    height: int = COARSE,
    cameras: int | None = None,
) -> list[Mask]:
    """Return some masks of the frames in which most moves and of others.

    Args:
        capture: Where they are from.
        usable: Sequence, frame and camera of the images that can be read and have a mask.
        height: Pixels to which higher images are reduced, by a whole number.
        cameras: How many cameras, spread as far as can be; None: all.
    """
    wanted = {camera.name for camera in capture.with_cameras(cameras).cameras}
    chosen = {index for index, camera in enumerate(capture.cameras) if camera.name in wanted}
    masks = []
    for sequence, frame in choose_frames(capture.motions, {place[:2] for place in usable}):
        for index in sorted(k for k in chosen if (sequence, frame, k) in usable):
            alpha = torch.tensor(capture.image(sequence, frame, index)[..., 3]).float() / 255
            reduction = -(-alpha.shape[0] // height)
            h, w = (size // reduction for size in alpha.shape)
            blocks = alpha[: h * reduction, : w * reduction].unflatten(0, (h, -1)).unflatten(2, (w, -1))
            masks.append(Mask(sequence, frame, index, blocks.mean((1, 3)), reduction))
    return masks


def choose_frames(
    motions: Mapping[str, Motion], usable: Collection[tuple[str, int]]
) -> list[tuple[str, int]]:
    """Return usable frames of all sequences: half of them where joints turn fastest, half evenly spread."""
    every = {
        (name, k): rate for name, motion in motions.items() for k, rate in enumerate(_frame_activity(motion))
    }
    places = [place for place in every if place in usable]
    if not places:
        return []
    rates = [every[place] for place in places]
    even = np.linspace(0, len(places) - 1, _FRAMES // 2).round().astype(int).tolist()
    fastest = sorted(range(len(places)), key=lambda index: -rates[index])
    apart: list[int] = []
    for index in fastest:
        if len(apart) < _FRAMES // 2 and all(abs(index - other) > 5 for other in apart):
            apart.append(index)
    return [places[index] for index in dict.fromkeys([*even, *apart])]


def crop_to_hands(hypothesis: Hypothesis, masks: Sequence[Mask]) -> list[Mask]:
    """Return the part of each mask about each hand that it shows."""
    parts = []
    for mask in masks:
        motion = hypothesis.motions[mask.sequence]
        transforms = forward_kinematics(
            hypothesis.body, motion.rotations[mask.frame], motion.translations[mask.frame]
        )
        joints = (transforms[:, :3, :3] @ hypothesis.body.joints[:, :, None])[..., 0] + transforms[:, :3, 3]
        pixels, depth = project(mask.at_mask_resolution(hypothesis.cameras[mask.camera]), joints)
        camera = mask.at_mask_resolution(hypothesis.cameras[mask.camera])
        for hand in _HANDS:
            margin = int(_REACH * float(camera.K[0, 0]) / max(float(depth[hand].min()), 0.1)) + 1
            (x0, y0), (x1, y1) = pixels[hand].amin(0).long() - margin, pixels[hand].amax(0).long() + margin
            box = (
                *(max(int(edge), 0) for edge in (x0, y0)),
                *(
                    min(int(edge), size)
                    for edge, size in zip((x1, y1), reversed(mask.alpha.shape), strict=True)
                ),
            )
            if box[2] > box[0] and box[3] > box[1] and mask.part(*box).alpha.sum() > 1:
                parts.append(mask.part(*box))
    return parts


def _frame_activity(motion: Motion) -> list[float]:
    """Return how much changes about each frame: turns in radians and steps in metres, by frame."""
    steps = motion.rotations.diff(dim=0).norm(dim=-1).clamp(max=1).sum(-1)
    steps = steps + 3 * motion.translations.diff(dim=0).norm(dim=-1).clamp(max=1)
    return [*steps.tolist(), 0.0]


def silhouette(
    vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"], camera: Camera
) -> Float[Tensor, "h w"]:
    """Return the share of each pixel that a mesh covers."""
    samples = max(1, min(4, _SAMPLES // camera.height))
    fine = camera.resized(samples * camera.width, samples * camera.height)
    hit = (rasterize_mesh(vertices, faces, fine).faces >= 0).float()
    return hit.unflatten(0, (-1, samples)).unflatten(2, (-1, samples)).mean((1, 3))


def compare(hypothesis: Hypothesis, masks: Sequence[Mask], shift: int = 0) -> Iterator[SilhouetteAgreement]:
    """Yield how each mask agrees with the body `shift` frames later."""
    for mask in masks:
        camera = mask.at_mask_resolution(hypothesis.cameras[mask.camera])
        body = silhouette(
            hypothesis.vertices(mask.sequence, mask.frame + shift), hypothesis.body.faces, camera
        )
        both, either = torch.minimum(body, mask.alpha).sum(), torch.maximum(body, mask.alpha).sum()
        outside, clothes = body.sum() - both, mask.alpha.sum() - both
        # A body that no camera sees is as wrong as can be.
        area = mask.alpha.sum().clamp_min(1.0)
        error = float((outside + _CLOTHES * clothes) / area) if body.sum() > 0 else 1.0
        yield SilhouetteAgreement(
            float(both / body.sum().clamp_min(1e-6)), float(both / either.clamp_min(1e-6)), min(error, 1.0)
        )


def silhouette_errors(
    hypothesis: Hypothesis, masks: Sequence[Mask], shift: int = 0
) -> Float[np.ndarray, " m"]:
    """Return the errors of all views."""
    return np.array([each.error for each in compare(hypothesis, masks, shift)])
