"""The true garment's points, followed by an avatar: where each of them would be if the avatar were right.

A capture's truth has points of its own, an avatar has texels. Which belong together is decided once, where
the garment hangs at rest in frames of training; from then on a true point rides on its nearest texels.

What is measured is how cloth moves. So true points are tied to the garment *as the avatar lets it hang at
rest*: what a network adds in the rest frames of training is taken off wherever it goes. A template that is a
centimetre too wide, or a network that mends it, would otherwise be charged for a mistake in shape, or earn by
mending it. At rest, template and network thus start with the same error: that of folds, which fall anew each
time.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.bilinear import BilinearSampling, sample_bilinear
from dsar.avatar.rest_frames import find_rest_frames
from dsar.avatar.rollout import network_outputs
from dsar.body.skinning import blend_transforms, forward_kinematics, skin_points
from dsar.data.captures.multiview import MultiViewCapture
from dsar.errors import CaptureError
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.types import Motion

REST_FRAMES, PER_SEQUENCE = 12, 3
"""Frames at rest that are looked at, in all and of a sequence."""
NEAREST = 4
"""Texels on which a true point rides."""
_SOFTENING = 2e-3
"""Metres within which a texel counts as at the point itself."""
_BLOCK = 1 << 22
"""Distances that are computed at a time."""


@dataclass(frozen=True)
class TrackedGarment:
    """True points of a garment on the texels of an avatar."""

    points: Float[Tensor, "v 3"]
    """Where they hang at rest, in the body's rest pose, metres."""
    weights: Float[Tensor, "v j"]
    """Skin weights: means of those of their texels."""
    texels: Int64[Tensor, "v k"]
    """Gaussians on which each of them rides."""
    shares: Float[Tensor, "v k"]
    """By how much; rows sum to 1."""
    resting: Float[Tensor, "v 3"]
    """Mean of what the network moves them by at rest, along the body's own axes, metres."""

    def offsets(self, avatar: Avatar, output: NetworkOutput) -> Float[Tensor, "v 3"]:
        """Return what a network's output moves each point by, along the body's own axes, metres."""
        return _mean_offsets(avatar, output, self.texels, self.shares) - self.resting

    def carry(
        self, transforms: Float[Tensor, "j 4 4"], offsets: Float[Tensor, "v 3"] | None = None
    ) -> Float[Tensor, "v 3"]:
        """Return the offset points as T_world_rest of the joints carries them, world metres."""
        points = self.points if offsets is None else self.points + offsets
        return skin_points(points, self.weights, transforms)


def track_garment(
    avatar: Avatar, capture: MultiViewCapture, streams: Collection[Stream] = STREAMS
) -> TrackedGarment:
    """Tie a capture's true garment to the texels of an avatar that has a garment's chart.

    Raises:
        CaptureError: no training sequence has a true garment, or sequences differ in its points.
    """
    truths = {name: capture.garment(name) for name in capture.splits["train"] if capture.garment_runs(name)}
    if not truths:
        raise CaptureError(
            f"capture {capture.name}: no training sequence has garment truth: "
            "where points of the garment lie at rest is not known"
        )
    check_same_points({name: truth.shape[1] for name, truth in truths.items()}, capture.name)
    transforms = {name: _transforms(avatar, capture.motions[name]) for name in truths}
    frames = find_rest_frames(transforms, capture.fps, REST_FRAMES, PER_SEQUENCE, lambda *_: True)
    poses = torch.stack([transforms[name][frame] for name, frame in frames])
    clouds = torch.stack([torch.from_numpy(truths[name][frame]) for name, frame in frames]).to(avatar.device)
    texels, shares = _nearest_texels(avatar, poses, clouds)
    weights = (avatar.texel_weights[texels] * shares[..., None]).sum(1)
    points = torch.stack([_unskin(cloud, weights, pose) for cloud, pose in zip(clouds, poses, strict=True)])
    outputs = _outputs_in(avatar, capture, frames, streams)
    resting = torch.stack([_mean_offsets(avatar, output, texels, shares) for output in outputs])
    return TrackedGarment(points.mean(0), weights, texels, shares, resting.mean(0))


def check_same_points(counts: Mapping[str, int], name: str) -> None:
    """Check that sequences agree in how many points their true garment has.

    Raises:
        CaptureError: they do not.
    """
    if len(set(counts.values())) > 1:
        raise CaptureError(
            f"capture {name}: expected as many points of the garment everywhere, found {counts}"
        )


def _transforms(avatar: Avatar, motion: Motion) -> Float[Tensor, "f j 4 4"]:
    poses = motion.rotations.to(avatar.device), motion.translations.to(avatar.device)
    return forward_kinematics(avatar.body, *poses)


def _nearest_texels(
    avatar: Avatar, poses: Float[Tensor, "r j 4 4"], clouds: Float[Tensor, "r v 3"]
) -> tuple[Int64[Tensor, "v k"], Float[Tensor, "v k"]]:
    """Return the texels that are nearest to each point in all rest frames together, and their shares."""
    garment = avatar.garment_texels()
    means, weights = avatar.template.means.detach()[garment], avatar.texel_weights[garment]
    surfaces = torch.stack([skin_points(means, weights, pose) for pose in poses])
    count, found = min(NEAREST, len(garment)), []
    for some in clouds.split(max(1, _BLOCK // (len(poses) * len(garment))), 1):
        squares = torch.cdist(some, surfaces).square().mean(0)
        found.append(squares.topk(count, largest=False))
    nearest = torch.cat([each.indices for each in found])
    shares = 1 / (torch.cat([each.values for each in found]) + _SOFTENING**2)
    return garment[nearest], shares / shares.sum(1, keepdim=True)


def _unskin(
    points: Float[Tensor, "v 3"], weights: Float[Tensor, "v j"], pose: Float[Tensor, "j 4 4"]
) -> Float[Tensor, "v 3"]:
    """Return where skinned points lie in the rest pose."""
    blended = blend_transforms(weights, pose)
    return torch.linalg.solve(blended[..., :3], points - blended[..., 3])


def _outputs_in(
    avatar: Avatar,
    capture: MultiViewCapture,
    frames: Sequence[tuple[str, int]],
    streams: Collection[Stream],
) -> Iterator[NetworkOutput]:
    """Yield the network's outputs in some frames, each rolled out from its sequence's cold start."""
    wanted: dict[str, set[int]] = defaultdict(set)
    for name, frame in frames:
        wanted[name].add(frame)
    for name, numbers in wanted.items():
        motion = capture.motions[name].slice(0, max(numbers) + 1)
        for frame, (_, output) in enumerate(network_outputs(avatar, motion, streams=streams)):
            if frame in numbers:
                yield output


def _mean_offsets(
    avatar: Avatar, output: NetworkOutput, texels: Int64[Tensor, "v k"], shares: Float[Tensor, "v k"]
) -> Float[Tensor, "v 3"]:
    """Return the offsets of texels, as `Avatar.gaussians` adds them, averaged by shares."""
    indices, weights = avatar.control.sampling
    flat = texels.flatten()
    along = sample_bilinear(output.offset, BilinearSampling(indices[flat], weights[flat]))[0]
    offsets = (avatar.texel_axes[flat] * along[:, None]).sum(-1)
    return (offsets.unflatten(0, texels.shape) * shares[..., None]).sum(1)
