"""Registration: offset maps of the garment, fitted to the images of the training frames one after another.

A rendered print tells where cloth is only while the guess is right to within half a period of it. A network
that starts from rest is not, and settles for a blur. From one frame to the next cloth hardly moves that far:
maps that follow it through a sequence keep its place, and are the network's first teacher (extension).
"""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.body.skinning import blend_transforms
from dsar.config import TrainConfig
from dsar.devices import send
from dsar.geometry.cameras import project
from dsar.raster import rasterize_views, reduced_dilation
from dsar.training.image_losses import image_losses
from dsar.training.kept_views import KeptViews
from dsar.training.losses import spatial_loss
from dsar.training.registered_maps import RegisteredMaps
from dsar.training.report import UpdateMetrics
from dsar.training.rest import RestOffsets
from dsar.training.targets import Target, load_target

REDUCTION = 2
"""Factor by which images are reduced."""
RATE, FAST_RATE = 0.01, 0.025
"""Adam's step, metres, usually and where the cloth is fast."""
STEPS = 12
"""Steps of Adam a frame."""
VIEWS, FAST_VIEWS = 2, 4
"""Cameras of a step, likewise."""
FAST = 0.035
"""Mean change of the offset, metres, that inertia asks for in one frame, above which the cloth is fast."""
STRIDES = (0.0, 0.5, 1.0, 1.4)
"""Shares of that change which are tried as the first guess then; rest is tried always."""
MARGIN = 8
"""Pixels kept around the garment."""
NOISE = 0.01
"""Metres of change that are noise rather than inertia."""
STRUCTURE = {"ssim": 0.5, "alpha": 0.3, "lpips": 0.0}
"""Image losses that differ from the network's: structure finds the place of a print."""
ROUGHNESS, JOLT = 0.0002, 0.001
"""Weights of how far neighbours part, in all and in this frame (cm²): the first alone, strong enough to keep
neighbours together, would also hold back a hem that swings away from the waist."""


class Registration:
    """One worker's share of the work to fit the registered maps."""

    def __init__(
        self,
        config: TrainConfig,
        views: KeptViews,
        avatar: Avatar,
        rest: RestOffsets,
        maps: RegisteredMaps,
        signals: Mapping[str, DrivingSignal],
    ) -> None:
        """Prepare to fit this worker's frames of `maps`.

        Args:
            config: The settings of the run.
            views: Its images.
            avatar: With a template that is fitted.
            rest: The garment in still frames.
            maps: What is fitted; those of this worker's sequences change.
            signals: Driving signals of the sequences.
        """
        self.views, self.capture = views, views.capture
        self.avatar, self.signals, self.seed = avatar, signals, config.seed
        self.rest, self.maps = rest, maps
        self.loss = dataclasses.replace(config.loss, **STRUCTURE)
        self.garment = avatar.garment_control_points()
        self.order = list(maps.clips)

    def fit_next(self) -> UpdateMetrics | None:
        """Fit this worker's next frame, if it has one left."""
        index = self.maps.count
        self.maps.count += 1
        return self.fit(*self.maps.own[index]) if index < len(self.maps.own) else None

    def fit(self, name: str, frame: int) -> UpdateMetrics | None:
        """Fit the map of a frame; those before it are fitted. Cloth that no camera saw stays as it was."""
        rng = np.random.default_rng([self.seed, self.order.index(name), frame])
        motion_window = self.signals[name].windows[frame : frame + 1]
        guesses, fast = self._guesses(motion_window, name, frame)
        points = self._posed(motion_window, guesses[0]).cpu()
        view = functools.cache(functools.partial(self._view, name, frame, points=points))
        cameras = self.capture.cameras_with_image(name, frame)
        if not cameras:
            if frame > self.maps.clips[name].start:
                self.maps.offsets[name][frame] = self.maps.offsets[name][frame - 1]
            self.maps.fitted[name] += 1
            return None

        def draw_views() -> list[tuple[Target, float]]:
            count = min(FAST_VIEWS if fast else VIEWS, len(cameras))
            return [view(int(k)) for k in rng.choice(cameras, count, replace=False)]

        guess = self._best(motion_window, guesses, draw_views())
        offset = guess.clone().requires_grad_()
        optimizer = torch.optim.Adam([offset], FAST_RATE if fast else RATE, betas=(0.8, 0.9))
        loss, mse = offset.new_zeros(()), offset.new_zeros(())
        for _ in range(STEPS):
            optimizer.zero_grad()
            loss, mse = self._compare(motion_window, offset, draw_views(), rng.random(3))
            loss = loss + JOLT * self._roughness(offset - guess)
            loss.backward(inputs=[offset])
            optimizer.step()
        self.maps.offsets[name][frame, self.garment] = offset.detach()
        self.maps.fitted[name] += 1
        return UpdateMetrics(*torch.stack([loss.detach(), mse]).tolist())

    @torch.no_grad()
    def _best(
        self, motion_window: Tensor, guesses: list[Float[Tensor, "g 3"]], views: list[tuple[Target, float]]
    ) -> Float[Tensor, "g 3"]:
        """Return the guess that the views like best."""
        losses = [self._compare(motion_window, guess, views, np.full(3, 0.5))[0] for guess in guesses]
        return guesses[int(torch.stack(losses).argmin())]

    @torch.no_grad()
    def _guesses(
        self, motion_window: Tensor, name: str, frame: int
    ) -> tuple[list[Float[Tensor, "g 3"]], bool]:
        """Return offsets to start from, and whether the cloth is fast.

        Rest is among them, so that a print that was lost is found again when the cloth comes to rest.
        """
        garment, frames_before = self.garment, frame - self.maps.clips[name].start
        rest = self.rest.earliest(name)
        if frames_before == 0:
            return [rest], False
        before = self.maps.offsets[name][frame - 1, garment]
        if frames_before == 1:
            return [before, rest], False
        change = self._inertia(motion_window, name, frame) - before
        norm = change.norm(dim=1, keepdim=True)
        change = change * norm / (norm + NOISE)
        fast = bool(norm.mean() > FAST)
        return [before + stride * change for stride in (STRIDES if fast else (1.0,))] + [rest], fast

    def _inertia(self, motion_window: Tensor, name: str, frame: int) -> Float[Tensor, "g 3"]:
        """Return the offsets of cloth that moves on through the world as it did before this frame."""
        avatar, garment, signal = self.avatar, self.garment, self.signals[name]
        past = self.maps.offsets[name]
        newest, older = (
            self._posed(signal.windows[f : f + 1], past[f, garment]) for f in (frame - 1, frame - 2)
        )
        moved = newest + self._smooth(newest - older)
        blended = blend_transforms(avatar.control.weights[garment], motion_window[:, :1])[0, 0]
        points = torch.linalg.solve(blended[..., :3], (moved - blended[..., 3])[..., None])[..., 0]
        return (avatar.control.axes[garment] * (points - avatar.control.points[garment])[..., None]).sum(1)

    def _compare(
        self,
        motion_window: Tensor,
        offset: Float[Tensor, "g 3"],
        views: list[tuple[Target, float]],
        background: np.ndarray,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return loss and squared error of views over a background, and how far neighbours part."""
        gaussians = self.avatar.gaussians(motion_window, self.avatar.offset_garment(offset[None]))[0]
        color = send(torch.from_numpy(background.astype(np.float32)), offset.device)
        targets, weights = [target for target, _ in views], torch.tensor([weight for _, weight in views])
        backgrounds = color.expand(len(views), 3)
        drawn = rasterize_views(
            [gaussians],
            [[target.camera for target in targets]],
            backgrounds=backgrounds,
            dilation=reduced_dilation(REDUCTION),
        )
        losses, errors = image_losses(drawn[0], targets, backgrounds, self.loss, None)
        loss = (losses * send(weights, offset.device)).mean()
        return loss + ROUGHNESS * self._roughness(offset), errors.mean()

    def _roughness(self, offset: Float[Tensor, "g 3"]) -> Float[Tensor, ""]:
        return spatial_loss(self.avatar.scatter_garment_points(offset[None]), self.avatar.control.edges)

    def _view(self, name: str, frame: int, camera: int, points: Float[Tensor, "g 3"]) -> tuple[Target, float]:
        """Return a view of the garment, and its share of the person's view.

        Around the garment's `points` in the world, which are in main memory: so nothing waits for a GPU.
        """
        target = load_target(self.views, name, frame, camera, REDUCTION)
        pixels = project(target.camera, points)[0]
        height, width = target.alpha.shape
        low, high = pixels.amin(0).floor().long() - MARGIN, pixels.amax(0).ceil().long() + MARGIN
        x0, y0 = min(max(int(low[0]), 0), width - 1), min(max(int(low[1]), 0), height - 1)
        x1, y1 = min(max(int(high[0]), x0 + 1), width), min(max(int(high[1]), y0 + 1), height)
        color, alpha = target.color[y0:y1, x0:x1].contiguous(), target.alpha[y0:y1, x0:x1].contiguous()
        part = Target(color, alpha, target.camera.cropped(x0, y0, x1 - x0, y1 - y0))
        return part, alpha.numel() / target.alpha.numel()

    def _posed(self, motion_window: Tensor, offset: Float[Tensor, "g 3"]) -> Float[Tensor, "g 3"]:
        """Return where the garment's control points are in the world."""
        output = self.avatar.offset_garment(offset[None])
        return self.avatar.deformed_control_points(motion_window, output)[0, self.garment]

    def _smooth(self, vectors: Float[Tensor, "g 3"]) -> Float[Tensor, "g 3"]:
        """Return the mean of each control point of the garment and its neighbours."""
        avatar = self.avatar
        spread = vectors.new_zeros(len(avatar.control.cells), 4)
        spread[self.garment] = torch.cat([vectors, vectors.new_ones(len(vectors), 1)], 1)
        total = spread.clone()
        for a, b in (avatar.control.edges.T, avatar.control.edges.T.flip(0)):
            total.index_add_(0, a, spread[b])
        return (total[:, :3] / total[:, 3:].clamp_min(1))[self.garment]
