"""Losses of one frame without its images: between neighbours on the surface, against a registered map."""

from jaxtyping import Float, Int64
from torch import Tensor

CENTIMETRES = 100.0
_KNEE = 0.5
"""Centimetres below which a distance is squared after all, to be smooth."""


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
