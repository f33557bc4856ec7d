"""The layers of a dressed person: what the body beneath a garment looks like.

A texel that a garment covers at times would take the garment's paint wherever the predicted cloth is not
quite where the true one is, and keep it when the cloth lifts. So it gets its colours once, from pixels of
the training images that no garment covers, by the registered maps or by the capture's own labels; where it
never was seen it takes the looks of the nearest texel that was. From then on it is fixed
(`Avatar.fix_looks`): neither images nor residuals change it.
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.garment_chart import arm_joints, tube_faces
from dsar.body.skinning import skin_points
from dsar.raster.jit import kernel
from dsar.raster.mesh import MeshView, rasterize_mesh
from dsar.training import workers
from dsar.training.kept_views import KeptViews
from dsar.training.registered_maps import RegisteredMaps
from dsar.training.targets import Target, load_target
from dsar.types import Camera

LOGGER = logging.getLogger(__name__)

FRAMES = 64
"""Training frames that are looked at: half of them those with the hem highest, the others evenly spread."""
WIDTH = 192
"""Pixels to which larger images are reduced."""
MARGIN, LABEL_MARGIN = 0.02, 0.01
"""Metres around a garment that are not taken for bare, by registered maps and by a capture's own labels."""
SHADE = 0.04
"""Metres in which the weight of a pixel falls to 1/e with its distance from the garment: skin just out of it
is in its shade, and mostly seen so."""
FEWEST = 3
"""Pixels that make a colour."""


@dataclass
class _Sightings:
    """What the views say of each texel, added up."""

    colors: Float[Tensor, "n 3"]
    """Weighted sum of sRGB over pixels without a garment."""
    weights: Float[Tensor, " n"]
    """Sum of their weights."""
    pixels: Float[Tensor, " n"]
    """How many those are."""
    covered: Float[Tensor, " n"]
    """Pixels in which a garment is before it."""


class Layers:
    """Finds the looks of the body beneath garments in a capture's training images."""

    def __init__(
        self,
        views: KeptViews,
        avatar: Avatar,
        maps: RegisteredMaps,
        signals: Mapping[str, DrivingSignal],
        clips: Mapping[str, range],
    ) -> None:
        """Prepare to look at training frames.

        Args:
            views: Its images, and the capture's labels where it has them.
            avatar: Whose body is looked at; its template is fitted.
            maps: Where the garment is in frames that have one.
            signals: Driving signals of the sequences.
            clips: Frames of each training sequence.
        """
        self.views, self.capture = views, views.capture
        self.avatar, self.maps = avatar, maps
        self.signals, self.clips = signals, clips
        # All of it in main memory, once a run: meshes are drawn there.
        self.garment = avatar.garment_texels()
        rows = sum(len(chart.rows) for chart in avatar.garments)
        self.tube = tube_faces(rows, avatar.atlas_size[1])
        self.body = avatar.body.to(device="cpu")
        self.texel_at = _texel_lookup(avatar)

    @torch.no_grad()
    def settle(self) -> None:
        """Show what is beneath the garment as it looks in images; all workers must call it at once."""
        avatar = self.avatar
        avatar.unhide_covered_texels()
        if not len(self.garment):
            return
        count = avatar.num_gaussians
        found = _Sightings(torch.zeros(count, 3), *(torch.zeros(count) for _ in range(3)))
        for index, (sequence, frame) in enumerate(self.frames()):
            if index % workers.world_size() == workers.rank():
                self._look(sequence, frame, found)
        workers.all_reduce([found.colors, found.weights, found.pixels, found.covered])
        covered = (found.covered > 0) & self._coverable()
        seen = found.pixels >= FEWEST
        colors = found.colors / found.weights.clamp_min(1e-6)[:, None]
        avatar.fix_looks(*(found.to(avatar.device) for found in (covered, colors, seen)))
        fixed = int(avatar.texel_beneath.sum())
        LOGGER.info(
            "Beneath the garment: %d texels, %.0f %% of them never seen without it: they look as the nearest "
            "that was",
            *(fixed, 100 * (avatar.borrowed_share or 0.0)),
        )

    def frames(self) -> list[tuple[str, int]]:
        """Return sequence and frame of what is looked at: those that say where the garment is."""
        everything = [(name, frame) for name, clip in self.clips.items() for frame in clip]
        mapped = [key for key in everything if self.maps.has_map(*key)]
        if not mapped:
            mapped = everything[:: math.ceil(len(everything) / FRAMES)]
            return mapped if any(self._labelled(*key) for key in mapped) else []
        even = mapped[:: math.ceil(2 * len(mapped) / FRAMES)]
        # Every other frame at most: neighbours show the same.
        lifted = sorted(mapped[::2], key=lambda key: -self._lift(*key))
        return even + [key for key in lifted if key not in even][: FRAMES - len(even)]

    def _labelled(self, sequence: str, frame: int) -> bool:
        cameras = self.capture.cameras_with_image(sequence, frame)
        return bool(cameras) and self.capture.garment_mask(sequence, frame, cameras[0]) is not None

    def _lift(self, sequence: str, frame: int) -> float:
        """Return how far the garment's control points are above where they rest, metres."""
        control = self.avatar.control
        points = self.avatar.garment_control_points()
        offsets = self.maps.offsets[sequence][frame, points]
        return float((control.axes[points, 1] * offsets).sum(-1).mean())

    def _coverable(self) -> Bool[Tensor, " n"]:
        """Return which texels of the body a garment may cover: those not above it, and no arms."""
        avatar = self.avatar
        heights = avatar.texel_positions[:, 1]
        body = torch.zeros_like(avatar.texel_beneath)
        body[avatar.texels_on(avatar.charts[:1])] = True
        arm = avatar.texel_weights[:, arm_joints()].sum(1) >= 0.5
        return (body & ~arm & (heights <= heights[self.garment].max())).cpu()

    def _look(self, sequence: str, frame: int, found: _Sightings) -> None:
        """Add what the views of a frame say."""
        vertices = skin_points(
            self.body.vertices, self.body.weights, self.signals[sequence].transforms[frame].cpu()
        )
        tube = self._tube(sequence, frame)
        for index in self.capture.cameras_with_image(sequence, frame):
            reduction = max(1, self.capture.cameras[index].width // WIDTH)
            target = load_target(self.views, sequence, frame, index, reduction)
            body = rasterize_mesh(vertices, self.body.faces, target.camera)
            labels = self.capture.garment_mask(sequence, frame, index)
            if labels is not None:
                over = _reduced(torch.from_numpy(labels), target, self.capture.cameras[index])
                closeness, margin = _closeness(over, body.depth, target.camera), LABEL_MARGIN
            elif tube is not None:
                cloth = rasterize_mesh(tube, self.tube, target.camera)
                over, margin = cloth.depth < body.depth, MARGIN
                closeness = _closeness(cloth.faces >= 0, cloth.depth, target.camera)
            else:
                continue
            texels = self._texels(body)
            whole = -_spread(-target.alpha, 1) > 1 - 1e-3
            free = whole & (closeness < math.exp(-margin / SHADE)) & (texels >= 0)
            found.colors.index_add_(0, texels[free], target.color[free] * closeness[free, None])
            found.weights.index_add_(0, texels[free], closeness[free])
            found.pixels.index_add_(0, texels[free], torch.ones(int(free.sum())))
            hidden = texels[over & (texels >= 0)]
            found.covered.index_add_(0, hidden, torch.ones(len(hidden)))

    def _tube(self, sequence: str, frame: int) -> Float[Tensor, "g 3"] | None:
        """Return the registered garment's texels in the world; None without a map."""
        if not self.maps.has_map(sequence, frame):
            return None
        own = slice(frame, frame + 1)
        offsets = self.maps.offsets[sequence][own][:, self.avatar.garment_control_points()]
        output = self.avatar.offset_garment(offsets)
        posed = self.avatar.gaussians(self.signals[sequence].windows[own], output)[0]
        return posed.means[self.garment].cpu()

    def _texels(self, view: MeshView) -> Int64[Tensor, "h w"]:
        """Return the texel that each pixel sees of the body; -1 where there is none."""
        resolution = self.avatar.atlas_size[1]
        hit = view.faces >= 0
        uv = self.body.uv[self.body.uv_faces[view.faces[hit]]]
        u, v = (view.weights[hit][..., None] * uv).sum(-2).unbind(-1)
        row, column = ((t * resolution).floor().long().clamp(0, resolution - 1) for t in (1 - v, u))
        texels = torch.full_like(view.faces, -1)
        texels[hit] = self.texel_at[row * resolution + column]
        return texels


def _texel_lookup(avatar: Avatar) -> Int64[Tensor, " g"]:
    """Return the Gaussian on each cell of the body's chart, -1 where there is none."""
    cells = torch.full((avatar.atlas_size[0] * avatar.atlas_size[1],), -1, dtype=torch.int64)
    body = avatar.texels_on(avatar.charts[:1])
    cells[avatar.texels[body].cpu()] = body.cpu()
    return cells


def _spread(image: Float[Tensor, "h w"], pixels: int) -> Float[Tensor, "h w"]:
    """Return the largest value within some pixels of each."""
    return torch.nn.functional.max_pool2d(image[None, None], 2 * pixels + 1, 1, pixels)[0, 0]


def _closeness(
    mask: Bool[Tensor, "h w"], depth: Float[Tensor, "h w"], camera: Camera
) -> Float[Tensor, "h w"]:
    """Return exp(-distance / SHADE) to a mask, from 1 in it to e^-3, at the median depth of what is there."""
    known, floor = depth[depth.isfinite()], math.exp(-3)
    if not len(known):
        return mask.float().clamp_min(floor)
    away = _pixels_away(mask.numpy()) * float(known.median() / camera.K[0, 0])
    return torch.from_numpy(np.exp(-away / SHADE)).clamp_min(floor)


def _pixels_away(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return each pixel's distance to a mask in steps to neighbours, diagonal ones as long as they are."""
    away = np.where(mask, 0, sum(mask.shape)).astype(np.float32)
    _sweep(away)
    _sweep(away[::-1, ::-1])
    return away


@kernel
def _sweep(away):
    """Shorten distances by steps from the left and from the row above."""
    height, width = away.shape
    diagonal = np.float32(np.sqrt(2.0))
    for row in range(height):
        for column in range(width):
            best = away[row, column]
            if column > 0:
                best = min(best, away[row, column - 1] + np.float32(1))
            if row > 0:
                best = min(best, away[row - 1, column] + np.float32(1))
                if column > 0:
                    best = min(best, away[row - 1, column - 1] + diagonal)
                if column + 1 < width:
                    best = min(best, away[row - 1, column + 1] + diagonal)
            away[row, column] = best


def _reduced(mask: Bool[Tensor, "h w"], target: Target, camera: Camera) -> Bool[Tensor, "h2 w2"]:
    """Return which pixels of a target hold any of a mask of the whole image of its camera."""
    reduction = round(float(camera.K[0, 0] / target.camera.K[0, 0]))
    left, top = (round(float(camera.K[i, 2] / reduction - target.camera.K[i, 2])) for i in (0, 1))
    coarse = torch.nn.functional.max_pool2d(mask.float()[None, None], reduction)[0, 0] > 0
    height, width = target.alpha.shape
    return coarse[top : top + height, left : left + width]
