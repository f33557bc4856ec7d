"""Skin weights as USD takes them: the largest few of each point."""

import numpy as np
import torch
from jaxtyping import Float32, Int32


def largest_influences(
    weights: Float32[torch.Tensor, "n j"], count: int
) -> tuple[Int32[np.ndarray, "n c"], Float32[np.ndarray, "n c"]]:
    """Return the joints with each point's largest weights, and these weights, scaled to sum to 1."""
    largest = weights.float().topk(min(count, weights.shape[1]), dim=1)
    normalized = largest.values / largest.values.sum(1, keepdim=True)
    return largest.indices.int().contiguous().numpy(), normalized.contiguous().numpy()
