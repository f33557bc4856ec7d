"""The body that a garment leaves free: where its paint would show.

Where the garment would hang at rest, but the true one is lifted, an image shows what is beneath it. These
pixels say whether a model knows that, or paints the body with its clothes.
"""

from jaxtyping import Bool, Float, Int64
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.garment_chart import PAST_HEM, tube_faces
from dsar.body.skinning import skin_points
from dsar.evaluation.views import View
from dsar.metrics.images import psnr
from dsar.raster.mesh import rasterize_mesh
from dsar.types import Camera

FEWEST = 16
"""Pixels below which a view has no figure: they would be the garment's very border."""


class RestingGarment:
    """A garment that only hangs on the skeleton: the avatar's chart of it, as far down as it was seen."""

    def __init__(self, positions: Float[Tensor, "r c 3"], weights: Float[Tensor, "r c j"]) -> None:
        """Take a tube's rest positions, metres, and skin weights; rows from waist to hem."""
        kept = int((positions[:, 0, 1] >= positions[-1, 0, 1] + PAST_HEM - 1e-5).sum())
        self._faces = tube_faces(kept, positions.shape[1])
        self._positions, self._weights = positions[:kept].flatten(0, 1), weights[:kept].flatten(0, 1)

    @classmethod
    def of(cls, avatar: Avatar) -> "RestingGarment | None":
        """Return the last garment of an avatar; None where it has none."""
        if not avatar.garments:
            return None
        texels, size = avatar.texels_on(avatar.garments[-1:]), (-1, avatar.atlas_size[1])
        return cls(*(of[texels].unflatten(0, size) for of in (avatar.texel_positions, avatar.texel_weights)))

    def silhouette(self, transforms: Float[Tensor, "j 4 4"], camera: Camera) -> Bool[Tensor, "h w"]:
        """Return the pixels whose centres it covers, carried by T_world_rest of the joints."""
        points = skin_points(self._positions, self._weights, transforms)
        # Meshes are drawn in main memory.
        return (rasterize_mesh(points.cpu(), self._faces, camera).faces >= 0).to(points.device)


def touched_pixels(
    vertices: Float[Tensor, "v 3"], faces: Int64[Tensor, "f 3"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Return the pixels that a mesh in world metres covers at any of four samples, whatever is before it."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    hit = rasterize_mesh(vertices, faces, fine).faces >= 0
    return hit.unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).any(3).any(1)


def psnr_uncovered(
    image: Float[Tensor, "h w 3"],
    truth: View,
    garment: Bool[Tensor, "h w"],
    resting: Bool[Tensor, "h w"],
) -> float | None:
    """Return the PSNR, dB, over white of the body that the garment leaves free; None where it leaves none.

    Args:
        image: Predicted, over white.
        truth: The true view.
        garment: Pixels that the true garment touches.
        resting: Pixels that it would cover at rest.
    """
    free = resting & ~garment & (truth.mask > 0.5)
    if int(free.sum()) < FEWEST:
        return None
    return psnr(image[free][None], truth.color[free][None])
