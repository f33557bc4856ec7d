"""Image losses (paper equation 23) and the three adaptive temporal regularisers (equations 17-21)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.avatar.input_maps import REFERENCE_FPS
from dsar.config import LossConfig
from dsar.metrics.images import ssim
from dsar.network import NetworkOutput
from dsar.training.fused_loss import fused_image_loss
from dsar.training.targets import Target
from dsar.types import RenderOutput

_GAMMA = 0.1
CENTIMETRES = 100.0
_KNEE = 0.5
"""Centimetres below which a distance is squared after all, to be smooth."""


def pyramid_l1(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], levels: int
) -> Float[Tensor, ""]:
    """Return the mean absolute difference, averaged over levels that halve the resolution.

    Coarse levels pull a garment towards a place it does not overlap yet.
    """
    difference = (image - target).permute(2, 0, 1)[None]
    total = difference.abs().mean()
    for _ in range(levels - 1):
        difference = torch.nn.functional.avg_pool2d(difference, 2, ceil_mode=True, count_include_pad=False)
        total = total + difference.abs().mean()
    return total / levels


def plain_image_loss(
    color: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    levels: int,
    weights: tuple[float, float, float],
) -> Float[Tensor, ""]:
    """Return the weighted sum of pyramid L1, 1 - SSIM, and the mean absolute difference of alpha and mask."""
    l1, similarity, cover = weights
    loss = l1 * pyramid_l1(color, truth, levels) + cover * (alpha - mask).abs().mean()
    return loss + similarity * (1 - ssim(color, truth)) if similarity else loss


def image_loss(
    output: RenderOutput,
    target: Target,
    background: Float[Tensor, "3"],
    config: LossConfig,
    lpips: torch.nn.Module | None,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return L_render of one view over a background, and its mean squared error for reporting."""
    truth = target.color + (1 - target.alpha[..., None]) * background
    on_cpu = truth.dtype == torch.float32 and truth.device.type == "cpu"
    compare = fused_image_loss if on_cpu else plain_image_loss
    weights = (config.l1, config.ssim, config.alpha)
    loss = compare(output.color, output.alpha, truth, target.alpha, config.pyramid, weights)
    if lpips is not None:
        pair = [image.permute(2, 0, 1)[None].clamp(0, 1) for image in (output.color, truth)]
        loss = loss + config.lpips * lpips(*pair).mean()
    return loss, (output.color - truth).detach().square().mean()


def spatial_loss(offsets: Float[Tensor, "b p 3"], edges: Int64[Tensor, "l 2"]) -> Float[Tensor, ""]:
    """Return the mean squared difference, in cm, of the offsets of neighbouring points; 0 without edges."""
    if not len(edges):
        return offsets.new_zeros(())
    change = (offsets[:, edges[:, 0]] - offsets[:, edges[:, 1]]) * CENTIMETRES
    return change.square().sum(2).mean()


def registered_loss(
    offsets: Float[Tensor, "b p 3"], registered: Float[Tensor, "b p 3"]
) -> Float[Tensor, " b"]:
    """Return the mean distance, in cm, of the control points' offsets to registered ones.

    Not squared: at rest the last millimetres count, in a spin the map itself is centimetres off.
    """
    error = (offsets - registered) * CENTIMETRES
    return ((error.square().sum(2) + _KNEE**2).sqrt() - _KNEE).mean(1)


@dataclass(frozen=True)
class TemporalRecord:
    """What the temporal losses remember of one frame of a batch of rollouts."""

    output: NetworkOutput
    """The network's residual maps and features."""
    posed: Float[Tensor, "b p 3"]
    """Deformed control points in the world, metres."""

    def detach(self) -> "TemporalRecord":
        """Cut the record from the autograd graph."""
        output = NetworkOutput(
            self.output.offset.detach(),
            self.output.appearance.detach(),
            tuple(feature.detach() for feature in self.output.features),
        )
        return TemporalRecord(output, self.posed.detach())


def temporal_losses(
    records: Sequence[TemporalRecord],
    speeds: Sequence[Float[Tensor, "b 1 h w"]],
    ages: list[int],
    occupied: Float[Tensor, "1 1 h w"],
    cells: Int64[Tensor, " p"],
    config: LossConfig,
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted temporal losses of the newest record against the one or two before it, by name.

    `records` are those of the newest frame and up to two before it, `speeds` the V of the window's frames,
    the newest last. `ages` counts the frames that each rollout has seen before the newest: rollouts without
    enough past are left out.
    """
    newest, losses = records[-1], {}
    if len(records) < 2:
        return losses
    one, two = (_have_seen(ages, past, newest.posed) for past in (1, 2))
    previous, scale = records[-2], config.temporal_scale
    weights = {frame: _weight(speeds, ages, frame, config) * occupied for frame in (-1, -2)}

    def over_rollouts(values: Float[Tensor, "b ..."], valid: Float[Tensor, " b"]) -> Float[Tensor, ""]:
        flat = values.flatten(1)
        return ((flat.mean(1) if config.reduction == "mean" else flat.sum(1)) * valid).mean()

    change = _change(newest.output, previous.output)
    losses["prediction"] = scale * config.prediction * over_rollouts(weights[-1] * change, one)
    pairs = zip(newest.output.features, previous.output.features, strict=True)
    apart = torch.stack([over_rollouts((current - past).square(), one) for current, past in pairs])
    losses["feature"] = scale * config.feature * _GAMMA * apart.sum()
    if len(records) > 2:
        acceleration = (newest.posed - 2 * previous.posed + records[-3].posed) * CENTIMETRES
        # It is the acceleration of the frame in the middle (equations 20-21).
        jolt = weights[-2].flatten(1)[:, cells] * acceleration.square().sum(-1)
        losses["smoothness"] = scale * config.smoothness * over_rollouts(jolt, two)
    return losses


def _weight(
    speeds: Sequence[Float[Tensor, "b 1 h w"]], ages: list[int], frame: int, config: LossConfig
) -> Float[Tensor, "b 1 h w"]:
    """Return exp(-V / tau_reg), V that of a frame (-1: the newest) or the window's largest (equation 17)."""
    if not config.adaptive:
        return torch.ones_like(speeds[-1])
    frames = [frame] if config.magnitude == "frame" else range(-len(speeds), 0)
    # What came before a rollout's restart is another motion.
    seen = [speeds[k] * _have_seen(ages, -1 - k, speeds[k])[:, None, None, None] for k in frames]
    return torch.exp(-torch.stack(seen).amax(0) * REFERENCE_FPS / config.tau)


def _have_seen(ages: list[int], past: int, like: Tensor) -> Float[Tensor, " b"]:
    """Return 1 for rollouts that have seen the frame so many before the newest, 0 for others."""
    return like.new_tensor([float(age >= past) for age in ages])


def _change(current: NetworkOutput, past: NetworkOutput) -> Float[Tensor, "b 1 h w"]:
    """Return the squared change of offset (cm), quaternion and log-scale between frames (equation 19)."""
    moved = (current.offset - past.offset) * CENTIMETRES
    turned = current.appearance[:, :7] - past.appearance[:, :7]
    return moved.square().sum(1, keepdim=True) + turned.square().sum(1, keepdim=True)
