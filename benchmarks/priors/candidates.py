"""All candidates for a motion prior, failures included."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from dsar.avatar.mirror import mirror_motion
from dsar.avatar.motion_prior import GRID
from dsar.dynamics.cloth import ClothConstants
from priors.clock import processor_ms
from priors.features import Memory, motion_features
from priors.modal import COMPONENTS as MODES
from priors.modal import drive, fit_modes
from priors.regression import COMPONENTS, compress, fit, fit_with, join, principal_axes
from priors.simulations import (
    USUAL_MAKE,
    Make,
    NearestAtFrameEnd,
    SimulatedGarment,
    stiff_folds,
    without_folds,
)
from priors.subject import Offsets, Subject

NETWORK = Memory(means=(0.1, 0.2, 0.4))
"""What the network has: `ModelConfig.mean_time_constants`."""
LONGER = Memory(means=(0.05, 0.1, 0.2, 0.4, 0.8, 1.6))
OSCILLATORS = Memory(means=(0.1, 0.3), oscillators=((0.6, 0.25), (1.0, 0.25), (1.6, 0.25)))
TURNING = Memory(means=(0.1, 0.2, 0.4), turning=True)
_USUAL = ClothConstants()
_MIRRORED = "mirrored "


@dataclass(frozen=True)
class Prediction:
    """What a candidate says."""

    offsets: Offsets
    """Of training sequences as they are when they are left out."""
    ms: float | None = None
    """The processor's time for a frame."""
    saw_training: bool = False
    """Whether it was fitted to training as a whole, none left out."""
    details: dict = field(default_factory=dict)


class Bench:
    """What candidates of one subject share."""

    def __init__(self, subject: Subject, generations: int) -> None:
        """Find the principal components of training."""
        self.subject, self.generations = subject, generations
        self.train = subject.train
        rows = np.concatenate([_flat(subject.offsets[name]) for name in self.train])
        self.axes = principal_axes(rows, COMPONENTS)[0].astype(np.float32)
        self.garment = cache(lambda grid: SimulatedGarment(subject, grid))
        self.timed = max(subject.validation or self.train, key=lambda name: len(subject.transforms[name]))
        """The motion on which all are timed."""

    @cached_property
    def fitted(self) -> ClothConstants:
        """The constants found from training's true cloth."""
        return self.garment(GRID).fit(self.generations)

    @cached_property
    def simulated(self) -> dict[str, Float[torch.Tensor, "f g 3"]]:
        """What the simulation with the fitted constants says, on its own grid."""
        return self.garment(GRID).displacements(self.fitted, self.subject.names)

    @cached_property
    def simulated_ms(self) -> float:
        """Its time for a frame."""
        return self.garment(GRID).milliseconds(self.fitted, self.timed)

    @cached_property
    def simulated_features(self) -> dict[str, Float[ndarray, "f k"]]:
        """Offsets and velocities of the simulated grid."""
        found = {}
        for name, offsets in self.simulated.items():
            flat = offsets.flatten(1).double().numpy()
            velocity = np.diff(flat, axis=0, prepend=flat[:1]) * self.subject.fps
            found[name] = np.concatenate([flat, velocity / 10], 1)
        return compress(found, self.train)

    def motion(self, memory: Memory) -> dict[str, Float[ndarray, "f k"]]:
        """Return features of all motions."""
        s = self.subject
        found = {
            name: motion_features(s.body, frames, s.fps, memory) for name, frames in s.transforms.items()
        }
        return compress(found, self.train)

    def motion_ms(self, memory: Memory) -> float:
        """Return the time that features of a frame take, in plain NumPy."""
        s, frames = self.subject, self.subject.transforms[self.timed]
        return processor_ms(lambda: motion_features(s.body, frames, s.fps, memory), len(frames))


Candidate = Callable[[Bench], Prediction]


def list_candidates() -> dict[str, Candidate]:
    """Return all candidates by what they are called."""
    no_pull = replace(ClothConstants(), pull=0.0, homing=0.0)
    return {
        "template": lambda bench: Prediction(bench.subject.resting()),
        "a second true run": _second_run,
        "regression: means .1 .2 .4 s": lambda bench: _from_motion(bench, NETWORK),
        "regression: means .05 to 1.6 s": lambda bench: _from_motion(bench, LONGER),
        "regression: oscillators": lambda bench: _from_motion(bench, OSCILLATORS),
        "regression: means, turning and its squares": lambda bench: _from_motion(bench, TURNING),
        "regression: means, mirrored training": _from_mirrored,
        "linear modes, stable": lambda bench: _modes(bench, legs=False),
        "linear modes, stable, with legs": lambda bench: _modes(bench, legs=True),
        "simulation": _simulate,
        "simulation, fitted": _fitted,
        "regression: simulation": _from_simulation,
        "regression: simulation, on simulation": lambda bench: _from_simulation(bench, on=True),
        "regression: means, on simulation": _means_on_simulation,
        "regression: simulation and means": lambda bench: _from_simulation(bench, NETWORK),
        "regression: simulation and means, on simulation": lambda bench: _from_simulation(
            bench, NETWORK, on=True
        ),
        "simulation 6x16": lambda bench: _simulate(bench, grid=(6, 16)),
        "simulation 12x32": lambda bench: _simulate(bench, grid=(12, 32)),
        "simulation, 120 steps/s": lambda bench: _simulate(bench, Make(steps=120)),
        "simulation, 480 steps/s": lambda bench: _simulate(bench, Make(steps=480)),
        "simulation 6x16, 120 steps/s": lambda bench: _simulate(bench, Make(steps=120), (6, 16)),
        "simulation 6x16, 120 steps/s, fitted": lambda bench: _refitted(bench, Make(steps=120), (6, 16)),
        "simulation 12x32, 480 steps/s": lambda bench: _simulate(bench, Make(steps=480), (12, 32)),
        "variant: nearest body point at the frame's end": _nearest_at_frame_end,
        "variant: folds resist widening": lambda bench: _simulate(bench, Make(weave=stiff_folds)),
        "variant: rest shape without folds": lambda bench: _simulate(bench, Make(weave=without_folds)),
        "variant: nothing draws it home": lambda bench: _simulate(bench, constants=no_pull),
    }


def _second_run(bench: Bench) -> Prediction | None:
    """Return other true outcomes where all of validation has one: nothing can be asked to beat them."""
    known = bench.subject.second
    if not all(name in known for name in bench.subject.validation):
        return None
    return Prediction(known)


def _simulate(
    bench: Bench,
    make: Make = USUAL_MAKE,
    grid: tuple[int, int] = GRID,
    constants: ClothConstants = _USUAL,
) -> Prediction:
    garment = bench.garment(grid)
    found = garment.spread(garment.displacements(constants, bench.subject.names, make))
    return Prediction(found, garment.milliseconds(constants, bench.timed, make))


def _nearest_at_frame_end(bench: Bench) -> Prediction:
    # Its search through all body points says nothing about its speed.
    return replace(_simulate(bench, Make(kind=NearestAtFrameEnd)), ms=None)


def _fitted(bench: Bench) -> Prediction:
    found = bench.garment(GRID).spread(bench.simulated)
    details = {"constants": asdict(bench.fitted)}
    return Prediction(found, bench.simulated_ms, saw_training=True, details=details)


def _refitted(bench: Bench, make: Make, grid: tuple[int, int]) -> Prediction:
    """Return what another make says with constants of its own."""
    constants = bench.garment(grid).fit(bench.generations, make)
    found = _simulate(bench, make, grid, constants)
    return replace(found, saw_training=True, details={"constants": asdict(constants)})


def _modes(bench: Bench, *, legs: bool) -> Prediction:
    s = bench.subject
    inputs = {name: drive(s.body, frames, s.fps, legs=legs) for name, frames in s.transforms.items()}
    axes = bench.axes[:MODES]
    targets = {name: (_flat(s.offsets[name]) @ axes.T).astype(np.float64) for name in bench.train}
    found = fit_modes(inputs, targets, bench.train, s.fps)
    return Prediction({name: _unflat(modes @ axes) for name, modes in found.items()})


def _from_motion(bench: Bench, memory: Memory) -> Prediction:
    return _regress(bench, bench.motion(memory), bench.motion_ms(memory))


def _from_simulation(bench: Bench, memory: Memory | None = None, *, on: bool = False) -> Prediction:
    """Return a regression from what the simulation says; `on`: of what it leaves of the cloth."""
    features, ms = bench.simulated_features, bench.simulated_ms
    if memory:
        features, ms = join(features, bench.motion(memory)), ms + bench.motion_ms(memory)
    return _regress(bench, features, ms, bench.garment(GRID).spread(bench.simulated) if on else None)


def _means_on_simulation(bench: Bench) -> Prediction:
    ms = bench.simulated_ms + bench.motion_ms(NETWORK)
    return _regress(bench, bench.motion(NETWORK), ms, bench.garment(GRID).spread(bench.simulated))


def _regress(
    bench: Bench, features: Mapping[str, ndarray], features_ms: float, base: Offsets | None = None
) -> Prediction:
    """Return a regression of true cloth, or of what a base leaves of it."""
    s, groups = bench.subject, [(name,) for name in bench.train]
    offsets = {name: s.offsets[name] - (base[name] if base else 0) for name in bench.train}
    targets = {name: (_flat(found) @ bench.axes.T).astype(np.float64) for name, found in offsets.items()}
    regression = fit(features, targets, groups)
    found = {}
    for name in s.names:
        known = regression.left_out.get(name)
        moved = _unflat((regression(features[name]) if known is None else known) @ bench.axes)
        found[name] = moved + base[name] if base else moved
    frames = features[bench.timed]
    ms = processor_ms(lambda: regression(frames) @ bench.axes, len(frames))
    details = {"kernel_length": regression.length, "ridge": regression.ridge}
    return Prediction(found, features_ms + ms, details=details)


def _from_mirrored(bench: Bench) -> Prediction:
    """Return a regression from twice the motions, with kernel and ridge found without their mirror images."""
    s, memory = bench.subject, NETWORK
    targets = {name: _flat(s.offsets[name]) @ bench.axes.T for name in bench.train}
    plain = fit(bench.motion(memory), targets, [(name,) for name in bench.train])
    flip = torch.tensor([-1.0, 1.0, 1.0])
    counterpart = torch.cdist(s.rest * flip, s.rest).argmin(1).numpy()
    transforms, groups = dict(s.transforms), []
    for name in bench.train:
        image = _MIRRORED + name
        transforms[image] = mirror_motion(s.transforms[name])
        targets[image] = _flat(s.offsets[name][:, counterpart] * flip.numpy()) @ bench.axes.T
        groups.append((name, image))
    seen = [name for group in groups for name in group]
    found = {name: motion_features(s.body, frames, s.fps, memory) for name, frames in transforms.items()}
    features = compress(found, seen)
    regression = fit_with(features, targets, groups, plain.length, plain.ridge)
    offsets = {}
    for name in s.names:
        known = regression.left_out.get(name)
        offsets[name] = _unflat((regression(features[name]) if known is None else known) @ bench.axes)
    return Prediction(offsets, details={"kernel_length": plain.length, "ridge": plain.ridge})


def _flat(offsets: Float[ndarray, "f n 3"]) -> Float[ndarray, "f k"]:
    return offsets.reshape(len(offsets), -1)


def _unflat(flat: Float[ndarray, "f k"]) -> Float[ndarray, "f n 3"]:
    return flat.reshape(len(flat), -1, 3).astype(np.float32)


def mean_square(errors: list[float]) -> float:
    """Return the root of the mean of squares."""
    return math.sqrt(sum(error**2 for error in errors) / len(errors))
