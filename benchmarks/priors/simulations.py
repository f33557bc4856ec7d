"""The simulation on the true garment's rest shape, in several makes, and the search for its constants."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from unittest.mock import patch

import cma
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.motion_prior import hang
from dsar.dynamics import simulation as dynamics
from dsar.dynamics.cloth import ClothConstants, build_constraints
from dsar.dynamics.collider import BodyCollider
from dsar.dynamics.simulation import ClothSimulation, ClothState, Fabric, Stage
from dsar.dynamics.solver import simulate
from dsar.dynamics.tube import average_tube, sample_tube
from dsar.training.prior_fitting import FARTHEST, SPREAD, USUAL, constants_at
from priors.clock import processor_ms
from priors.subject import Offsets, Subject

POPULATION = 10
REST_POSES, FITTED = 2, 5
"""Poses in which the cloth hangs to find its rest; the training sequences that move most are fitted to."""
_EVERY = 5
"""Of the garment's points that the search compares."""
_HARMONICS = 2
"""Of a rest shape without its folds."""

Weave = Callable[[ClothSimulation, ClothConstants], Fabric]


def usual_weave(simulation: ClothSimulation, constants: ClothConstants) -> Fabric:
    """Return the garment as the product has it."""
    return simulation.fabric(constants)


def stiff_folds(simulation: ClothSimulation, constants: ClothConstants) -> Fabric:
    """Return a garment whose struts along the rows resist widening as well as narrowing."""
    fabric = simulation.fabric(constants)
    sides = np.maximum(fabric.constraints.sides, 0)
    return Fabric(constants, replace(fabric.constraints, sides=sides))


def without_folds(simulation: ClothSimulation, constants: ClothConstants) -> Fabric:
    """Return a garment whose lengths are those of a rest shape without folds."""
    rest = simulation.rest.numpy().reshape(*simulation.shape, 3)
    waves = np.fft.rfft(rest, axis=1)
    waves[:, _HARMONICS + 1 :] = 0
    smooth = np.fft.irfft(waves, rest.shape[1], axis=1).astype(np.float32)
    return Fabric(constants, build_constraints(smooth, constants))


class NearestAtFrameEnd(ClothSimulation):
    """A simulation that looks for the nearest body point once a frame, where the body is at its end."""

    def advance(
        self, state: ClothState, stage: Stage, fabric: Fabric, fps: float
    ) -> tuple[np.ndarray, ClothState]:
        """Return what the simulation does, a frame at a time."""
        state, parts, constraints = state.copy(), [], fabric.constraints
        nobody = np.empty((len(self.collider), 0), np.int32)
        for frame in range(1, len(stage.home)):
            body = stage.body[frame]
            state.nearest[:] = (np.square(body).sum(1) - 2 * state.points @ body.T).argmin(1)
            part, both = np.empty((1, *state.points.shape), np.float32), slice(frame - 1, frame + 1)
            simulate(
                state.points, state.velocities, state.nearest,
                stage.home[both], stage.body[both], stage.normals[both], nobody,
                constraints.ends, constraints.lengths, constraints.compliances, constraints.sides,
                fabric.constants.of_motion, self.shape,
                max(1, round(dynamics.STEPS_PER_SECOND / fps)), float(fps), part,
            )  # fmt: skip
            parts.append(part)
        return np.concatenate(parts), state


@dataclass(frozen=True)
class Make:
    """How the garment is simulated."""

    steps: int = dynamics.STEPS_PER_SECOND
    """A second."""
    weave: Weave = usual_weave
    kind: type[ClothSimulation] = ClothSimulation


USUAL_MAKE = Make()


class SimulatedGarment:
    """A subject's garment on one grid."""

    def __init__(self, subject: Subject, grid: tuple[int, int]) -> None:
        """Prepare all motions."""
        self.subject = subject
        height, width = subject.shape
        places = torch.linspace(0, grid[0] - 1, height)
        rest = average_tube(subject.rest.unflatten(0, subject.shape), places, grid)
        weights = average_tube(subject.weights.unflatten(0, subject.shape), places, grid)
        heights = rest[..., 1]
        collider = BodyCollider(subject.body, float(heights.max()), float(heights.min()))
        self.simulation = ClothSimulation(collider, rest, weights / weights.sum(-1, keepdim=True))
        self.stages = {name: self.simulation.stage(subject.transforms[name]) for name in subject.names}
        down, columns = (
            axis.flatten() for axis in torch.meshgrid(places, torch.arange(width).float(), indexing="ij")
        )
        self.sampling = sample_tube(down, columns, width, grid)
        few = slice(width, None, _EVERY)
        self.few = sample_tube(down[few], columns[few], width, grid)

    def displacements(
        self, constants: ClothConstants, names: tuple[str, ...], make: Make = USUAL_MAKE
    ) -> dict[str, Float[Tensor, "f g 3"]]:
        """Return by sequence the way of the grid's points from where they hang at rest."""
        simulation, fabric = self._made(constants, make)
        with _steps(make.steps):
            still = [self.stages[name] for name in self.subject.train[:REST_POSES]]
            hanging = hang(simulation, fabric, still, self.subject.fps)
            return {
                name: simulation.displacements(self.stages[name], fabric, self.subject.fps, hanging) - hanging
                for name in names
            }

    def milliseconds(self, constants: ClothConstants, name: str, make: Make = USUAL_MAKE) -> float:
        """Return the processor's time for a frame of a motion, from its transforms to the cloth's points."""
        simulation, fabric = self._made(constants, make)
        fps, transforms = self.subject.fps, self.subject.transforms[name]
        with _steps(make.steps):
            state = simulation.begin(self.stages[name], fabric, fps)
            return processor_ms(
                lambda: simulation.advance(state, simulation.stage(transforms), fabric, fps), len(transforms)
            )

    def _made(self, constants: ClothConstants, make: Make) -> tuple[ClothSimulation, Fabric]:
        plain = self.simulation
        shape = plain.shape
        rest, weights = plain.rest.unflatten(0, shape), plain.weights.unflatten(0, shape)
        return make.kind(plain.collider, rest, weights), make.weave(plain, constants)

    def spread(self, displacements: dict[str, Float[Tensor, "f g 3"]]) -> Offsets:
        """Return displacements at the garment's own points."""
        return {name: self.sampling(found).numpy() for name, found in displacements.items()}

    def fit(self, generations: int, make: Make = USUAL_MAKE, seed: int = 1) -> ClothConstants:
        """Return the constants with which training moves most like the truth (`dsar.training.prior_fitting`).

        It compares all three coordinates of the truth where training from images has registered maps.
        """
        moving = {n: float(np.square(self.subject.offsets[n]).mean()) for n in self.subject.train}
        names = tuple(sorted(moving, key=moving.__getitem__)[-FITTED:])
        few = slice(self.subject.shape[1], None, _EVERY)
        targets = {name: torch.from_numpy(self.subject.offsets[name][:, few]) for name in names}

        def loss(logarithms: np.ndarray) -> float:
            found = self.displacements(constants_at(logarithms), names, make)
            errors = [
                (self.few(found[name]) - target).norm(dim=-1).clamp_max(FARTHEST).mean()
                / target.norm(dim=-1).mean()
                for name, target in targets.items()
            ]
            return float(torch.stack(errors).mean()) + USUAL * float(np.square(logarithms).sum())

        options = {"seed": seed, "popsize": POPULATION, "verbose": -9}
        search = cma.CMAEvolutionStrategy(np.zeros(len(ClothConstants().to_vector())), SPREAD, options)
        for _ in range(generations):
            tried = search.ask()
            search.tell(tried, [loss(each) for each in tried])
        usual = np.zeros_like(search.result.xfavorite)
        return constants_at(min(usual, search.result.xfavorite, key=loss))


@contextlib.contextmanager
def _steps(count: int) -> Iterator[None]:
    """Let the solver take so many steps a second: no setting, since only this comparison asks for others."""
    with patch.object(dynamics, "STEPS_PER_SECOND", count):
        yield
