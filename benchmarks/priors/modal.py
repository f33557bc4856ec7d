"""A reduced model whose dynamics are stable by construction: damped oscillators, driven linearly.

Each principal component of the cloth is an oscillator of a period and a damping of its own, driven by the
accelerations of the pelvis's frame, by gravity's direction in it and by its centrifugal terms. Given period
and damping the drive is a linear regression on what the oscillator makes of each input.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from dsar.types import Body
from priors.features import leg_points, local, turning_rate

COMPONENTS = 20
PERIODS, DAMPINGS = (0.15, 0.3, 0.5, 0.75, 1.0, 1.4, 2.0), (0.15, 0.4, 0.8, 1.5)
"""Seconds and damping ratios among which each component has its own."""
RIDGES = (1e-3, 1e-2, 1e-1, 1.0)
"""Weights of the ridge, of inputs with a variance of 1, a frame."""


def drive(
    body: Body, transforms: Float[Tensor, "f j 4 4"], fps: float, *, legs: bool
) -> Float[ndarray, "f k"]:
    """Return what drives the cloth: the pelvis's frame as it is felt from within, and where the legs are."""
    pelvis = transforms[:, 0].double().numpy()
    turn, joint = pelvis[:, :3, :3], body.joints[0].double().numpy()
    place = turn @ joint + pelvis[:, :3, 3]
    acceleration = np.zeros_like(place)
    acceleration[2:] = np.diff(place, 2, axis=0) * fps**2
    rate = turning_rate(turn, fps)
    spin_up = np.diff(rate, axis=0, prepend=rate[:1]) * fps
    products = np.stack([rate[:, a] * rate[:, b] for a in range(3) for b in range(a, 3)], 1)
    found = [local(turn, acceleration[:, None]), turn[:, 1], spin_up, products]
    if legs:
        found.append(local(turn, leg_points(body, transforms) - place[:, None]))
    return np.concatenate(found, 1)


def oscillate(
    inputs: Float[ndarray, "f k"], period: float, damping: float, fps: float
) -> Float[ndarray, "f k"]:
    """Return how a damped oscillator follows inputs that are held through each frame, solved exactly.

    It rests where the first input holds it, and follows a constant one to its value.
    """
    rate = 2 * np.pi / period
    root = np.emath.sqrt(damping**2 - 1 + 0j)
    poles = -rate * (damping + np.array([1, -1]) * root)
    # x(t) = sum of c_i exp(p_i t) about the input, from place and velocity.
    modes = np.array([[1, 1], poles])
    step = (modes @ np.diag(np.exp(poles / fps)) @ np.linalg.inv(modes)).real
    state, places = np.stack([np.zeros_like(inputs[0])] * 2), np.empty_like(inputs)
    held = inputs[0]
    for frame, value in enumerate(inputs):
        state[0] += held - value
        held = value
        state = step @ state
        places[frame] = held + state[0]
    return places


def fit_modes(
    inputs: Mapping[str, Float[ndarray, "f k"]],
    targets: Mapping[str, Float[ndarray, "f c"]],
    train: Sequence[str],
    fps: float,
) -> dict[str, Float[ndarray, "f c"]]:
    """Return predictions for all sequences; those of training are of models that were not fitted to them."""
    rows = np.concatenate([inputs[name] for name in train])
    mean, spread = rows.mean(0), rows.std(0) + 1e-9
    scaled = {name: (found - mean) / spread for name, found in inputs.items()}
    components = targets[train[0]].shape[1]
    best = np.full(components, np.inf)
    found = {name: np.zeros((len(values), components)) for name, values in inputs.items()}
    for period in PERIODS:
        for damping in DAMPINGS:
            moved = {name: oscillate(values, period, damping, fps) for name, values in scaled.items()}
            for ridge in RIDGES:
                tried = _regress(moved, targets, train, ridge)
                errors = sum(np.square(tried[name] - targets[name]).mean(0) for name in train)
                better = errors < best
                best[better] = errors[better]
                for name, predicted in tried.items():
                    found[name][:, better] = predicted[:, better]
    return found


def _regress(moved: Mapping, targets: Mapping, train: Sequence[str], ridge: float) -> dict[str, ndarray]:
    """Return linear predictions with a constant; of training sequences by the others."""
    inputs = {name: np.pad(values, ((0, 0), (0, 1)), constant_values=1.0) for name, values in moved.items()}
    squares = {name: inputs[name].T @ inputs[name] for name in train}
    products = {name: inputs[name].T @ targets[name] for name in train}
    all_squares, all_products = sum(squares.values()), sum(products.values())
    frames = sum(len(inputs[name]) for name in train)
    weight = ridge * frames * np.eye(len(all_squares))
    predictions = {}
    for name, values in inputs.items():
        left, right = all_squares, all_products
        if name in squares:
            left, right = left - squares[name], right - products[name]
        predictions[name] = values @ np.linalg.solve(left + weight, right)
    return predictions
