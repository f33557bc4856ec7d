"""Whether photographs fit their masks: a mask's edge should lie where the photograph has one."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from dsar.data.multiview import MultiViewCapture
from dsar.evaluation.check.agreement import COARSE, choose_frames

_TURNS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
}
_FEWEST = 3
"""Views of a camera from which it can be judged."""
_CLEARER, _SURER = 0.1, 4.0
"""By how much, and by how many standard errors, a turned mask must fit better."""
_FITTING = 0.7
"""How well it must fit: 0.5 is chance, 1 the sharpest edges of the image."""


@dataclass(frozen=True)
class Misfit:
    """Cameras whose photographs would fit their masks if they were changed."""

    cameras: Sequence[int]
    """Indices in the capture."""
    how: str
    """What the photographs are, in words that follow `are`."""
    before: float
    """How well masks fit as they are: 0.5 is chance, 1 the sharpest edges of the images."""
    after: float
    """How well they would."""


def find_misfits(capture: MultiViewCapture, usable: Collection[tuple[str, int, int]]) -> list[Misfit]:
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
                scores[index].append(np.array(fits(image[..., :3], image[..., 3])))
    groups: dict[str, list[int]] = defaultdict(list)
    for index, views in scores.items():
        turn = _better(np.array(views))
        if turn is not None:
            groups[turn].append(index)
    misfits = []
    for how, cameras in groups.items():
        means = np.concatenate([scores[index] for index in cameras]).mean(0)
        misfits.append(Misfit(cameras, how, float(means[0]), float(means[1 + list(_TURNS).index(how)])))
    return misfits


def fits(color: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"]) -> list[float]:
    """Return how sharp a photograph is along its mask's edge, by rank among all its pixels.

    First with the mask as it is, then as each of `_TURNS` would have it. 0.5 is chance, 1 the sharpest edges.
    """
    edges, outline = _edges(color), _edges(alpha[..., None])
    # Flat backgrounds are equal everywhere: their pixels share one rank.
    levels, place, counts = np.unique(edges, return_inverse=True, return_counts=True)
    assert len(levels) == len(counts)
    ranks = ((np.cumsum(counts) - counts / 2) / edges.size)[place.reshape(edges.shape)]
    weights = [outline, *(turn(outline) for turn in _TURNS.values())]
    return [float((ranks * each).sum() / max(each.sum(), 1e-9)) for each in weights]


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


def _edges(image: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w"]:
    """Return how much an image changes about each pixel."""
    rows, columns = np.gradient(image, axis=(0, 1))
    return np.sqrt((rows**2 + columns**2).sum(-1)).round(4)


def _reduced(image: UInt8[np.ndarray, "h w 4"]) -> Float[np.ndarray, "y x 4"]:
    reduction = -(-image.shape[0] // COARSE)
    h, w = (size // reduction for size in image.shape[:2])
    blocks = image[: h * reduction, : w * reduction].reshape(h, reduction, w, reduction, 4)
    return blocks.astype(np.float32).mean((1, 3))
