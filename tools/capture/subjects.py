"""The persons that come with the package: who wears what, which solver moves it, what they do."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from jaxtyping import Float
from numpy import ndarray

from capture.choreography import OneToMany, Take
from capture.cloth import Fabric
from capture.garment import FLARED, Cut, Skirt, drape
from capture.prints import paint_skirt
from capture.tartan import paint_tartan
from capture.wool import WOOL_CUT, Wool, drape_wool
from dsar.types import Body, Motion

SEED = 7
Drape = Callable[[Body, Skirt, Motion, int], Float[ndarray, "f n 3"]]
"""Body, skirt, motion and number of the run to the skirt's vertices, world metres."""
Paint = Callable[[Float[ndarray, " n"], Float[ndarray, " n"], float, int], Float[ndarray, "n 3"]]
"""Radius and angle in the flat cut, the whole cut's angle and a seed to linear albedo."""


@dataclass(frozen=True)
class Subject:
    """One embedded capture."""

    name: str
    folder: str
    """In dsar/data."""
    cut: Cut
    paint: Paint
    print_seed: int
    quality: int
    """Of the lossy WebP colours; the mask in the alpha channel stays exact."""
    lengths: Mapping[str, int] | None
    """Sequences with images and their frames, as far as the choreography has them; none: all, whole."""
    needs_blender: bool = False


FLORAL = Subject("embedded", "embedded", FLARED, paint_skirt, 5, 77, None)
WOOL = Subject(
    *("embedded-wool", "embedded_wool", WOOL_CUT, paint_tartan, 5, 42),
    {"sway": 46, "spin_both": 116, "twists": 80, "jumps": 46, "walk": 78, "far": 96},
    needs_blender=True,
)
SUBJECTS = {subject.name: subject for subject in (FLORAL, WOOL)}
_WIND, _PULL = 0.6, 3.0
"""Disturbance that makes a second true run: m/s for our solver, m/s^2 for Blender's."""


def select_takes(
    subject: Subject, takes: Mapping[str, Take], pair: OneToMany
) -> tuple[dict[str, Take], OneToMany]:
    """Return a subject's own sequences, cut to their lengths; the pair's frames stay within theirs."""
    if subject.lengths is None:
        return dict(takes), pair
    own = {
        name: replace(takes[name], motion=takes[name].motion.slice(0, frames))
        for name, frames in subject.lengths.items()
    }
    last = len(own[pair.sequence].motion) - 1
    first = pair.after_stop[0]
    return own, replace(pair, after_stop=(first, min(pair.after_stop[1], last)))


def draper(subject: Subject, blender_python: Path | None) -> Drape:
    """Return what simulates a subject's skirt; the path is of a Python with `bpy`, if it needs one."""
    if blender_python is None or not subject.needs_blender:
        return lambda body, skirt, motion, run: drape(body, skirt, motion, Fabric(), SEED, _WIND * run)
    return lambda body, skirt, motion, run: drape_wool(
        body, skirt, motion, Wool(), blender_python, SEED, _PULL * run
    )
