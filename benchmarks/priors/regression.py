"""Kernel ridge regression of true cloth, checked on sequences that were left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Features = Mapping[str, Float[ndarray, "f k"]]
"""By sequence."""
COMPONENTS = 30
"""Principal components of the training sequences' cloth that are predicted."""
LENGTHS, RIDGES = (1.5, 3.0, 6.0, 12.0), (1e-2, 1e-1, 1.0, 10.0)
"""Lengths of the Gaussian kernel, in standard deviations of a feature, and weights of the ridge."""


def principal_axes(rows: Float[ndarray, "n k"], count: int) -> tuple[Float[ndarray, "c k"], ndarray]:
    """Return the first right singular vectors, and their singular values."""
    wide = rows.shape[1] > len(rows)
    squares, vectors = np.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)
    count = min(count, len(squares))
    values = np.sqrt(np.maximum(squares[::-1][:count], 0))
    axes = vectors[:, ::-1][:, :count].T
    return (axes @ rows / np.maximum(values[:, None], 1e-12) if wide else axes), values


def compress(features: Features, train: Sequence[str], count: int = 40) -> dict[str, ndarray]:
    """Return principal components of features, half-way whitened, with a standard deviation of 1 in all."""
    rows = np.concatenate([features[name] for name in train]).astype(np.float64)
    mean = rows.mean(0)
    axes, values = principal_axes(rows - mean, count)
    axes = axes / np.sqrt(values / np.sqrt(len(rows)) + 1e-9)[:, None]
    scale = ((rows - mean) @ axes.T).std() + 1e-9
    return {name: (found - mean) @ axes.T / scale for name, found in features.items()}


def join(*several: Features) -> dict[str, ndarray]:
    """Return features of several kinds side by side."""
    return {name: np.concatenate([each[name] for each in several], 1) for name in several[0]}


@dataclass(frozen=True)
class Regression:
    """A regression that is fitted."""

    length: float
    ridge: float
    inputs: Float[ndarray, "n k"]
    """The training frames' features."""
    factors: Float[ndarray, "n c"]
    left_out: dict[str, Float[ndarray, "f c"]]
    """What was predicted for each training sequence while it was left out."""

    def __call__(self, features: Float[ndarray, "f k"]) -> Float[ndarray, "f c"]:
        """Return predictions."""
        return kernel(features, self.inputs, self.length) @ self.factors


def fit(features: Features, targets: Features, groups: Sequence[Sequence[str]]) -> Regression:
    """Return the regression that errs least on groups of sequences when they are left out."""
    tried = (fit_with(features, targets, groups, x, y) for x in LENGTHS for y in RIDGES)
    return min(tried, key=lambda found: _squared_error(found.left_out, targets, groups))


def fit_with(
    features: Features, targets: Features, groups: Sequence[Sequence[str]], length: float, ridge: float
) -> Regression:
    """Return a regression with such a kernel; only the first of each group is kept of what was left out.

    A group is left out without another fit: with P = (K + ridge)^-1 and factors P y, its predictions are
    y_S - P_SS^-1 (P y)_S.
    """
    names = [name for group in groups for name in group]
    inputs = np.concatenate([features[name] for name in names])
    wanted = np.concatenate([targets[name] for name in names])
    gram = kernel(inputs, inputs, length)
    gram[np.diag_indices_from(gram)] += ridge
    precision = np.linalg.inv(gram)
    factors = precision @ wanted
    left_out, start = {}, 0
    for group in groups:
        count = sum(len(features[name]) for name in group)
        some = slice(start, start + count)
        predicted = wanted[some] - np.linalg.solve(precision[some, some], factors[some])
        left_out[group[0]] = predicted[: len(features[group[0]])]
        start += count
    return Regression(length, ridge, inputs, factors, left_out)


def kernel(a: Float[ndarray, "n k"], b: Float[ndarray, "m k"], length: float) -> Float[ndarray, "n m"]:
    """Return the Gaussian kernel; a length of 1 is that of typical distances."""
    squares = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return np.exp(-np.maximum(squares, 0) / (2 * a.shape[1] * length**2))


def _squared_error(left_out: Features, targets: Features, groups: Sequence[Sequence[str]]) -> float:
    return sum(float(np.square(left_out[group[0]] - targets[group[0]]).mean()) for group in groups)
