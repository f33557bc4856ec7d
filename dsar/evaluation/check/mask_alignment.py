"""Whether photographs fit their masks: person and surroundings differ in colour, where the mask says so."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.check.silhouettes import COARSE, choose_frames

_TURNS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
}
_FEWEST = 3
"""Views of a camera from which it can be judged."""
_CLEARER, _SURER = 0.08, 2.5
"""By how much, and by how many standard errors, a turned mask must fit better."""
_FITTING = 0.2
"""How well it must fit."""
_LEVELS = 6
"""Of each channel that are told apart."""


@dataclass(frozen=True)
class MisalignedMasks:
    """Cameras whose photographs would fit their masks if they were changed."""

    cameras: Sequence[int]
    """Indices in the capture."""
    how: str
    """What the photographs are, in words that follow `are`."""
    before: float
    """Share of the masks that the photographs' colours tell."""
    after: float
    """Share that they would tell."""


def find_misaligned_masks(
    capture: MultiViewCapture, usable: Collection[tuple[str, int, int]]
) -> list[MisalignedMasks]:
    """Return cameras whose photographs and masks are turned against each other.

    Args:
        capture: One with photographs: colours also where the masks are empty.
        usable: Sequence, frame and camera of the images that can be read and have a mask.
    """
    scores: dict[int, list[Float[np.ndarray, " t"]]] = defaultdict(list)
    for sequence, frame in choose_frames(capture.motions, {place[:2] for place in usable}):
        for index in range(len(capture.cameras)):
            if (sequence, frame, index) in usable:
                image = _reduced(capture.image(sequence, frame, index))
                scores[index].append(np.array(mask_information(image[..., :3], image[..., 3])))
    groups: dict[str, list[int]] = defaultdict(list)
    for index, views in scores.items():
        misalignment = _better(np.array(views))
        if misalignment is not None:
            groups[misalignment].append(index)
    misfits = []
    for how, cameras in groups.items():
        means = np.concatenate([scores[index] for index in cameras]).mean(0)
        misfits.append(
            MisalignedMasks(cameras, how, float(means[0]), float(means[1 + list(_TURNS).index(how)]))
        )
    return misfits


def mask_information(color: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"]) -> list[float]:
    """Return how much of a mask a photograph's colours tell: mutual information by the mask's entropy.

    First of the mask as it is, then as each of `_TURNS` would have it; 0 is nothing, 1 all of it. Turning
    keeps what both hold, so that chance is the same in all.
    """
    bins = ((color / 256 * _LEVELS).astype(int) * np.array([_LEVELS**2, _LEVELS, 1])).sum(-1).ravel()
    counts = np.bincount(bins, minlength=_LEVELS**3)
    used = counts > 0
    entropy = max(float(_entropy(np.array([alpha.mean() / 255]))[0]), 1e-9)
    shares = []
    for mask in (alpha, *(turn(alpha) for turn in _TURNS.values())):
        inside = np.bincount(bins, weights=mask.ravel() / 255, minlength=_LEVELS**3)
        left = (counts[used] * _entropy(inside[used] / counts[used])).sum() / counts.sum()
        shares.append(1 - float(left) / entropy)
    return shares


def _better(views: Float[np.ndarray, "v t"]) -> str | None:
    """Return what turns a camera's masks so that they fit clearly better; None where nothing does."""
    if len(views) < _FEWEST:
        return None
    names = list(_TURNS)
    best = 1 + int(views[:, 1:].mean(0).argmax())
    gain = views[:, best] - views[:, 0]
    chance = gain.std(ddof=1) / len(gain) ** 0.5
    clear = gain.mean() > max(_CLEARER, _SURER * chance) and views[:, best].mean() > _FITTING
    return names[best - 1] if clear else None


def _entropy(share: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    probability = np.clip(share, 1e-12, 1 - 1e-12)
    return -(probability * np.log(probability) + (1 - probability) * np.log(1 - probability))


def _reduced(image: UInt8[np.ndarray, "h w 4"]) -> Float[np.ndarray, "y x 4"]:
    reduction = -(-image.shape[0] // COARSE)
    h, w = (size // reduction for size in image.shape[:2])
    blocks = image[: h * reduction, : w * reduction].reshape(h, reduction, w, reduction, 4)
    return blocks.astype(np.float32).mean((1, 3))
