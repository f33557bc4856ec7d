"""How large the input maps were in training, by which they are standardised."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.avatar.input_maps import InputMaps


class InputStatistics(nn.Module):
    """Means and deviations of the input maps over the control points and the training motions."""

    map_mean: Tensor
    map_scale: Tensor
    magnitude_scale: Tensor

    def __init__(self, channels: int) -> None:
        """Start with means of 0 and deviations of 1 for maps of some channels."""
        super().__init__()
        self.register_buffer("map_mean", torch.zeros(channels, 1, 1))
        self.register_buffer("map_scale", torch.ones(channels, 1, 1))
        self.register_buffer("magnitude_scale", torch.ones(()))

    @torch.no_grad()
    def fit(self, maps: Float[Tensor, "n c p"], magnitudes: Float[Tensor, "n 1 p"]) -> None:
        """Set the statistics from values of the training motions at the control points, metres."""
        # Positions are centred; velocities and the like keep their zero, which means rest.
        self.map_mean[:3] = maps[:, :3].mean((0, 2))[:, None, None]
        deviation = (maps - self.map_mean[:, 0]).square().mean((0, 2)).sqrt()
        self.map_scale.copy_(deviation.clamp_min(1e-3)[:, None, None])
        self.magnitude_scale.copy_(magnitudes.square().mean().sqrt().clamp_min(1e-3))

    def standardize(self, inputs: InputMaps) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Return maps and magnitudes over their deviations."""
        return (inputs.maps - self.map_mean) / self.map_scale, inputs.magnitude / self.magnitude_scale
