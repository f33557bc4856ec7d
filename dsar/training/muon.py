"""Muon (Jordan et al. 2024): momentum whose matrix is orthogonalised before it is applied.

All directions of a step get the same length. In short runs the cloth's dynamics were learnt in fewer updates
than with Adam (docs/log/losses-and-schedule.md).

After each step a weight gets back the norm it had (Karras et al. 2024, EDM2). Steps of a fixed length would
make it grow with their number, and nothing in this network normalises: in 3,000 updates its features grew
400- to 12,000-fold.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

_STEPS = 5
_A, _B, _C = 3.4445, -4.7750, 2.0315


class Muon(torch.optim.Optimizer):
    """For weights of two and more axes; the first axis is the matrix's rows, all others its columns."""

    def __init__(self, parameters: Iterable[nn.Parameter], momentum: float = 0.95) -> None:
        super().__init__(parameters, {"lr": 0.0, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Turn every weight by its rate along the orthogonalised Nesterov momentum of its gradient."""
        if closure is not None:
            raise ValueError("Muon takes no closure: gradients are computed before the step")
        for group in self.param_groups:
            by_shape = defaultdict(list)
            for weight in group["params"]:
                if weight.grad is not None:
                    by_shape[weight.flatten(1).shape].append(weight)
            for (rows, columns), weights in by_shape.items():
                rate = group["lr"] * max(1.0, rows / columns) ** 0.5
                momenta = torch.stack([self._momentum(w, group["momentum"]).flatten(1) for w in weights])
                for weight, step in zip(weights, orthogonalize(momenta), strict=True):
                    norm = weight.norm()
                    weight.add_(step.view_as(weight), alpha=-rate)
                    weight.mul_(norm / weight.norm())

    def _momentum(self, weight: Tensor, momentum: float) -> Tensor:
        """Return the Nesterov momentum of a weight's gradient."""
        state = self.state[weight]
        if "average" not in state:
            state["average"] = torch.zeros_like(weight)
        assert weight.grad is not None
        average = state["average"].lerp_(weight.grad, 1 - momentum)
        return weight.grad.lerp(average, momentum)


def orthogonalize(matrices: Float[Tensor, "b r c"]) -> Float[Tensor, "b r c"]:
    """Return matrices with all singular values brought to about 1 (0.7 to 1.2), singular vectors kept.

    Five steps of an odd polynomial applied to the singular values; a zero matrix stays zero.
    """
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp_min(1e-30)
    for _ in range(_STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=_B, alpha=_C), x, beta=_A)
    return x.mT if tall else x
