"""The learnable template: raw parameters of the canonical Gaussians (paper section 3.3)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dsar.geometry.harmonics import dc_from_color
from dsar.geometry.rotations import quaternion_from_matrix

SCALE_RANGE = (2e-4, 0.1)
"""Standard deviations are kept within these metres."""
SCALE_IN_TEXELS = 0.5
"""First standard deviations in texels: neighbours overlap without blurring each other."""
VISIBLE_LOGIT, HIDDEN_LOGIT = 2.0, -8.0
"""First logits of opacity."""
THICKNESS = 0.3
"""First thickness as a fraction of the shorter side."""


class GaussianParameters(nn.Module):
    """Raw, unbounded values; `activate` is the only way to physical ones."""

    def __init__(
        self,
        positions: Float[Tensor, "n 3"],
        tangents: Float[Tensor, "n 3 2"],
        hidden: Bool[Tensor, " n"],
        sh_degree: int,
    ) -> None:
        """Start grey, one Gaussian as large and as flat as its texel (see `ChartTexels.tangents`).

        Those that are `hidden` are too transparent to be drawn, and so get no gradient.
        """
        super().__init__()
        n = len(positions)
        self.means = nn.Parameter(positions.clone())
        rotations, scales = texel_footprints(tangents)
        self.quaternions = nn.Parameter(rotations)
        self.log_scales = nn.Parameter(scales.log())
        self.opacity_logits = nn.Parameter(torch.where(hidden, HIDDEN_LOGIT, VISIBLE_LOGIT))
        harmonics = torch.zeros(n, (sh_degree + 1) ** 2, 3)
        harmonics[:, 0] = dc_from_color(torch.tensor([0.5, 0.5, 0.5]))
        self.harmonics = nn.Parameter(harmonics)

    @torch.no_grad()
    def reset_shapes(
        self, which: Bool[Tensor, " n"], positions: Float[Tensor, "n 3"], tangents: Float[Tensor, "n 3 2"]
    ) -> None:
        """Make some Gaussians the footprints of their texels again."""
        rotations, scales = texel_footprints(tangents[which])
        self.means[which], self.quaternions[which] = positions[which], rotations
        self.log_scales[which] = scales.log()

    def activate(
        self,
        offset: Float[Tensor, "b n 3"] | None = None,
        appearance: Float[Tensor, "b n a"] | None = None,
        fixed: Bool[Tensor, " n"] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return canonical means, rotations, scales, opacities and harmonics, batch first.

        Without residuals it is the template itself, in a batch of one. Residuals are added to the raw
        values: metres to means, then quaternion 4, log-scale 3, logit 1, harmonics 3k (paper equation 2).
        Gaussians that are `fixed` move with the offset, but look as they do: no residual of theirs counts,
        and their parameters get no gradient.
        """
        raw = (self.means, self.quaternions, self.log_scales, self.opacity_logits, self.harmonics)
        if fixed is not None:
            raw = tuple(torch.where(_like(fixed, value), value.detach(), value) for value in raw)
            if appearance is not None:
                appearance = appearance.masked_fill(fixed[:, None], 0.0)
        means, quaternions, log_scales, logits, harmonics = (value[None] for value in raw)
        if offset is not None and appearance is not None:
            quaternion, log_scale, logit, harmonic = appearance.split([4, 3, 1, appearance.shape[-1] - 8], -1)
            means = means + offset
            quaternions, log_scales = quaternions + quaternion, log_scales + log_scale
            logits = logits + logit.squeeze(-1)
            harmonics = harmonics + harmonic.unflatten(-1, (-1, 3))
        rotations = nn.functional.normalize(quaternions, dim=-1)
        return means, rotations, log_scales.exp().clamp(*SCALE_RANGE), logits.sigmoid(), harmonics


def _like(flags: Bool[Tensor, " n"], values: Float[Tensor, "n *c"]) -> Bool[Tensor, "n *_"]:
    """Return flags with as many dimensions as values."""
    return flags.reshape(-1, *[1] * (values.ndim - 1))


def texel_footprints(
    tangents: Float[Tensor, "n 3 2"],
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "n 3"]]:
    """Return rotations (wxyz) and standard deviations that make each Gaussian its texel's footprint.

    The singular directions of the texel's sides are the first two axes, so that a stretched texel is
    covered from end to end, named and signed after the sides they follow, so that neighbours agree; the
    third is the normal, THICKNESS times as wide as the shorter side.
    """
    directions, sides, _ = torch.linalg.svd(tangents, full_matrices=False)
    along = (directions.mT @ tangents).abs()
    crossed = along[:, 0, 0] * along[:, 1, 1] < along[:, 0, 1] * along[:, 1, 0]
    directions = torch.where(crossed[:, None, None], directions.flip(-1), directions)
    sides = torch.where(crossed[:, None], sides.flip(-1), sides)
    directions = directions * torch.where((directions * tangents).sum(1, keepdim=True) < 0, -1, 1)
    normals = torch.linalg.cross(directions[..., 0], directions[..., 1])
    axes = torch.cat([directions, normals[..., None]], -1)
    scales = SCALE_IN_TEXELS * torch.cat([sides, THICKNESS * sides.amin(1, keepdim=True)], 1)
    return quaternion_from_matrix(axes), scales.clamp(*SCALE_RANGE)
