"""The learnable template: raw parameters of the canonical Gaussians (paper section 3.1)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.geometry.harmonics import dc_from_color

SCALE_RANGE = (2e-4, 0.1)
"""Standard deviations are kept within these metres."""


class GaussianParameters(nn.Module):
    """Raw, unbounded values; `activate` is the only way to physical ones."""

    def __init__(self, positions: Float[Tensor, "n 3"], sh_degree: int) -> None:
        super().__init__()
        n = len(positions)
        self.means = nn.Parameter(positions.clone())
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1))
        spacing = nearest_distances(positions).clamp(*SCALE_RANGE)
        self.log_scales = nn.Parameter(spacing.log()[:, None].repeat(1, 3))
        self.opacity_logits = nn.Parameter(torch.full((n,), 2.0))
        harmonics = torch.zeros(n, (sh_degree + 1) ** 2, 3)
        harmonics[:, 0] = dc_from_color(torch.tensor([0.5, 0.5, 0.5]))
        self.harmonics = nn.Parameter(harmonics)

    def activate(
        self,
        offset: Float[Tensor, "b n 3"] | None = None,
        appearance: Float[Tensor, "b n a"] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return canonical means, rotations, scales, opacities and harmonics, batch first.

        Without residuals it is the template itself, in a batch of one. Residuals are added to the raw
        values: metres to means, then quaternion 4, log-scale 3, logit 1, harmonics 3k (equation 3).
        """
        quaternions, log_scales = self.quaternions[None], self.log_scales[None]
        logits, harmonics, means = self.opacity_logits[None], self.harmonics[None], self.means[None]
        if offset is not None and appearance is not None:
            turn, stretch, logit, shade = appearance.split([4, 3, 1, appearance.shape[-1] - 8], -1)
            means = means + offset
            quaternions, log_scales = quaternions + turn, log_scales + stretch
            logits = logits + logit.squeeze(-1)
            harmonics = harmonics + shade.unflatten(-1, (-1, 3))
        rotations = nn.functional.normalize(quaternions, dim=-1)
        return means, rotations, log_scales.exp().clamp(*SCALE_RANGE), logits.sigmoid(), harmonics


def nearest_distances(points: Float[Tensor, "n 3"], neighbours: int = 6) -> Float[Tensor, " n"]:
    """Return the mean distance of each point to its nearest neighbours, metres."""
    rows = []
    for chunk in points.split(1024):
        distances = torch.cdist(chunk, points).topk(neighbours + 1, largest=False).values
        rows.append(distances[:, 1:].mean(1))
    return torch.cat(rows)
