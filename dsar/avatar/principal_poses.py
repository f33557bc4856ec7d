"""Poses limited to what training has seen: a baseline against memory (Li et al. 2024)."""

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn


class PrincipalPoses(nn.Module):
    """The principal components of the training poses' position maps, onto which new poses are projected.

    In training, and without components, maps pass unchanged.
    """

    def __init__(self, components: int, points: int, max_deviations: float) -> None:
        """Start with components that are zero, for position maps of that many control points.

        A pose may be `max_deviations` standard deviations of a component away from the mean of training.
        """
        super().__init__()
        self.max_deviations = max_deviations
        self.mean: Tensor
        self.basis: Tensor
        self.deviation: Tensor
        self.register_buffer("mean", torch.zeros(3 * points))
        self.register_buffer("basis", torch.zeros(components, 3 * points))
        self.register_buffer("deviation", torch.zeros(components))

    @torch.no_grad()
    def fit(self, positions: Float[Tensor, "f 3 p"]) -> None:
        """Set the components from the control points' positions in training frames, metres, heading frame."""
        if not len(self.basis):
            return
        flat = positions.flatten(1)
        self.mean.copy_(flat.mean(0))
        _, sizes, basis = torch.linalg.svd(flat - self.mean, full_matrices=False)
        count = min(len(sizes), len(self.basis))
        self.basis[:count] = basis[:count]
        self.deviation[:count] = sizes[:count] / len(flat) ** 0.5

    def forward(
        self, maps: Float[Tensor, "b c h w"], cells: Int64[Tensor, " p"]
    ) -> tuple[Float[Tensor, "b c h w"], Int[Tensor, " b"]]:
        """Return input maps whose positions, the first three channels, are the nearest that training allows.

        Return, too, how many components of each pose were limited. `cells` are flat grid indices of the
        control points.
        """
        if self.training or not len(self.basis):
            return maps, torch.zeros(len(maps), dtype=torch.int64, device=maps.device)
        position = maps[:, :3].flatten(2)
        coefficients = (position[:, :, cells].flatten(1) - self.mean) @ self.basis.mT
        bound = self.max_deviations * self.deviation
        points = self.mean + torch.clamp(coefficients, -bound, bound) @ self.basis
        projected = position.index_copy(2, cells, points.unflatten(1, (3, -1)))
        limited = (coefficients.abs() > bound).sum(1)
        return torch.cat([projected.unflatten(2, maps.shape[2:]), maps[:, 3:]], 1), limited
