"""What the input maps were in training: it standardises them, and says which poses are known."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from dsar.avatar.guards import LIMITS, Guard
from dsar.avatar.input_maps import InputMaps
from dsar.config import ModelConfig


class InputStatistics(nn.Module):
    """Means and deviations of the input maps over the training motions, and principal components of poses."""

    map_mean: Tensor
    map_scale: Tensor
    magnitude_scale: Tensor
    pose_mean: Tensor
    pose_basis: Tensor
    pose_deviation: Tensor

    def __init__(self, model: ModelConfig, points: int) -> None:
        """Start with means of 0 and deviations of 1 for a number of control points."""
        super().__init__()
        self.pose_components = model.pose_components
        self.register_buffer("map_mean", torch.zeros(model.map_channels, 1, 1))
        self.register_buffer("map_scale", torch.ones(model.map_channels, 1, 1))
        self.register_buffer("magnitude_scale", torch.ones(()))
        self.register_buffer("pose_mean", torch.zeros(3 * points))
        self.register_buffer("pose_basis", torch.zeros(model.pose_components, 3 * points))
        self.register_buffer("pose_deviation", torch.zeros(model.pose_components))

    @torch.no_grad()
    def fit(self, maps: Float[Tensor, "n c p"], magnitudes: Float[Tensor, "n 1 p"]) -> None:
        """Set the statistics from values of the training motions at the control points."""
        # Positions are centred; velocities and the like keep their zero, which means rest.
        self.map_mean[:3] = maps[:, :3].mean((0, 2))[:, None, None]
        deviation = (maps - self.map_mean[:, 0]).square().mean((0, 2)).sqrt()
        self.map_scale.copy_(deviation.clamp_min(1e-3)[:, None, None])
        self.magnitude_scale.copy_(magnitudes.square().mean().sqrt().clamp_min(1e-3))
        if self.pose_components:
            positions = maps[:, :3].flatten(1)
            self.pose_mean.copy_(positions.mean(0))
            _, singular_values, basis = torch.linalg.svd(positions - self.pose_mean, full_matrices=False)
            count = min(len(singular_values), self.pose_components)
            self.pose_basis[:count] = basis[:count]
            self.pose_deviation[:count] = singular_values[:count] / len(positions) ** 0.5

    def standardize(self, inputs: InputMaps) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Return maps and magnitudes over their deviations."""
        return (inputs.maps - self.map_mean) / self.map_scale, inputs.magnitude / self.magnitude_scale

    def project_onto_training_poses(self, inputs: InputMaps, cells: Int64[Tensor, " p"]) -> InputMaps:
        """Return the same with the nearest position maps that the components of the training poses allow.

        Args:
            inputs: Input maps.
            cells: Flat grid indices of the control points.
        """
        flat = inputs.maps[:, :3].flatten(2)
        coefficients = (flat[:, :, cells].flatten(1) - self.pose_mean) @ self.pose_basis.mT
        bound = LIMITS.pose * self.pose_deviation
        points = self.pose_mean + torch.clamp(coefficients, -bound, bound) @ self.pose_basis
        position = flat.index_copy(2, cells, points.unflatten(1, (3, -1))).unflatten(2, inputs.maps.shape[2:])
        counts = {**inputs.guard_counts, Guard.POSE: (coefficients.abs() > bound).sum(1)}
        return InputMaps(torch.cat([position, inputs.maps[:, 3:]], 1), inputs.magnitude, counts)
