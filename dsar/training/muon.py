"""Muon (Jordan et al. 2024): momentum whose matrix is orthogonalised before it is applied.

All directions of a step get the same length. In short runs the cloth's dynamics were learnt in fewer updates
than with Adam (docs/log/losses-and-schedule.md).

After each step a weight gets back the norm it had (Karras et al. 2024, EDM2). Steps of a fixed length would
make it grow with their number, and nothing in this network normalises: in 3,000 updates its features grew
400- to 12,000-fold.
"""

# torch documents its operations on lists of tensors, but does not export them.
# pyright: reportPrivateImportUsage=false

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

_STEPS = 5
_A, _B, _C = 3.4445, -4.7750, 2.0315
_LEAST_SQUARED_NORM = 1e-37
"""Of a matrix that does not count as zero."""


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
            weights = [weight for weight in group["params"] if weight.grad is not None]
            if not weights:
                continue
            gradients, momentum = [weight.grad for weight in weights], group["momentum"]
            averages = [self._average(weight) for weight in weights]
            torch._foreach_lerp_(averages, gradients, 1 - momentum)
            momenta = torch._foreach_lerp(gradients, averages, momentum)
            steps = orthogonalize([each.flatten(1) for each in momenta])
            norms = torch.stack(torch._foreach_norm(weights))
            torch._foreach_mul_(steps, [-group["lr"] * max(1.0, len(s) / s.shape[1]) ** 0.5 for s in steps])
            torch._foreach_add_(weights, [s.view_as(w) for s, w in zip(steps, weights, strict=True)])
            growth = torch.stack(torch._foreach_norm(weights)) / norms
            for weight, factor in zip(weights, growth.unbind(), strict=True):
                weight.div_(factor)

    def _average(self, weight: Tensor) -> Tensor:
        """Return the running average of a weight's gradient."""
        state = self.state[weight]
        if "average" not in state:
            state["average"] = torch.zeros_like(weight)
        return state["average"]


def orthogonalize(matrices: Sequence[Float[Tensor, "_ _"]]) -> list[Float[Tensor, "_ _"]]:
    """Return matrices with all singular values brought to about 1 (0.7 to 1.2), singular vectors kept.

    Five steps of an odd polynomial applied to the singular values; a zero matrix stays zero. Each step is
    X' = P X with P a polynomial of X X^T, and so all of them together are one factor that X X^T gives: only
    matrices of the shorter side's size are multiplied over and over, and all of one size at once.
    """
    tall = [matrix.shape[0] > matrix.shape[1] for matrix in matrices]
    wide = [matrix.mT if flip else matrix for matrix, flip in zip(matrices, tall, strict=True)]
    factors = _in_batches(_orthogonalizing, _in_batches(lambda x: x @ x.mT, wide))
    products = _in_batches(torch.bmm, factors, wide)
    return [product.mT if flip else product for product, flip in zip(products, tall, strict=True)]


def _orthogonalizing(grams: Float[Tensor, "b r r"]) -> Float[Tensor, "b r r"]:
    """Return what X is multiplied by, from X X^T."""
    squared = grams.diagonal(dim1=1, dim2=2).sum(1)[:, None, None].clamp_min(_LEAST_SQUARED_NORM)
    unit = torch.eye(grams.shape[1], dtype=grams.dtype, device=grams.device)
    gram, factor = grams / squared, squared.rsqrt() * unit
    for step in range(_STEPS):
        polynomial = torch.baddbmm(gram, gram, gram, beta=_B, alpha=_C)
        factor = torch.baddbmm(factor, polynomial, factor, beta=_A)
        if step < _STEPS - 1:
            # All of them are polynomials of one matrix: their order does not matter.
            gram = torch.baddbmm(gram, polynomial, gram, beta=_A)
            gram = torch.baddbmm(gram, polynomial, gram, beta=_A)
    return factor


def _in_batches(function: Callable[..., Tensor], *operands: Sequence[Tensor]) -> list[Tensor]:
    """Return a function of each matrix, or of matrices in pairs, computed at once for those of one shape."""
    places = defaultdict(list)
    for index, own in enumerate(zip(*operands, strict=True)):
        places[tuple(matrix.shape for matrix in own)].append(index)
    results: dict[int, Tensor] = {}
    for indices in places.values():
        batches = [torch.stack([operand[index] for index in indices]) for operand in operands]
        results |= zip(indices, function(*batches).unbind(), strict=True)
    return [results[index] for index in range(len(results))]
