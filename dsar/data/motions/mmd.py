"""How far a motion's poses are from those of training."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Motion

_BODY = slice(1, 22)
"""The body's joints; the root is left out: where one stands and faces is no pose."""
_ROWS = 1024
NEAR, FAR = 0.3, 0.6
"""The paper's limits: below the first a sequence is near the training ones (nd), above the other far (fd)."""


def pose_features(motion: Motion) -> Float[Tensor, "f 126"]:
    """Return two columns of the rotation matrix of each of the body's 21 joints."""
    return matrix_from_axis_angle(motion.rotations[:, _BODY])[..., :2].flatten(1)


def median_distance(features: Float[Tensor, "n d"]) -> float:
    """Return the median distance of two poses, the usual bandwidth of the kernel."""
    subset = features[:: max(1, len(features) // _ROWS)]
    return float(torch.pdist(subset).median())


def mmd(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"], bandwidth: float) -> float:
    """Return the maximum mean discrepancy of two samples of at least two poses each (paper equation 24).

    The root of the unbiased estimate of MMD² of Gretton et al. (2012) with the kernel
    exp(-d² / (2 bandwidth²)); 0 where that estimate is below zero. The paper gives no features, bandwidth or
    estimator: its limits of near (0.3) and far (0.6) need not fit these.
    """

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        return torch.exp(-torch.cdist(a, b).square() / (2 * bandwidth**2))

    def within(a: Tensor) -> Tensor:
        # A pose is not compared with itself, whose kernel is 1.
        return (kernel(a, a).sum() - len(a)) / (len(a) * (len(a) - 1))

    squared = within(x) + within(y) - 2 * kernel(x, y).mean()
    return float(squared.clamp_min(0).sqrt())


@dataclass(frozen=True)
class PoseDistribution:
    """The poses of training, from which those of other motions are told apart."""

    features: Float[Tensor, "n d"]
    """Of each pose (`pose_features`)."""
    bandwidth: float
    """Of the kernel."""

    @classmethod
    def from_motions(cls, motions: Iterable[Motion]) -> "PoseDistribution":
        """Return the distribution of all poses of some motions, at least two."""
        features = torch.cat([pose_features(motion) for motion in motions])
        return cls(features, median_distance(features))

    def mmd(self, motions: Iterable[Motion]) -> float:
        """Return how far the poses of other motions are from these: the MMD, not its square."""
        return mmd(self.features, torch.cat([pose_features(motion) for motion in motions]), self.bandwidth)


def label_sequences(
    motions: Mapping[str, Motion], splits: Mapping[str, Sequence[str]]
) -> dict[str, tuple[str, ...]]:
    """Return the test sequences that are near the training ones (`nd`) and far from them (`fd`), by MMD."""
    if sum(len(motions[name]) for name in splits["train"]) < 2:
        return {}
    training = PoseDistribution.from_motions(motions[name] for name in splits["train"])
    labels: dict[str, tuple[str, ...]] = {}
    for name in splits["test"]:
        if len(motions[name]) > 1:
            distance = training.mmd([motions[name]])
            label = "nd" if distance < NEAR else "fd" if distance > FAR else None
            if label:
                labels[label] = (*labels.get(label, ()), name)
    return labels
