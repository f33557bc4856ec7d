"""What kind of cloth a garment is: constants of its simulation, found from the registered maps.

Images say where cloth went, and registration has read it from them. Of all kinds of cloth the simulation
takes the one that goes there, too. One that is far from usual cloth has to explain more: odd constants can
explain a few motions and fail on others.
"""

import copy
import dataclasses
import logging
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.motion_prior import GarmentPrior, hang
from dsar.dynamics.cloth import ClothConstants
from dsar.dynamics.simulation import ClothSimulation, Stage
from dsar.training import workers
from dsar.training.registered_maps import RegisteredMaps

LOGGER = logging.getLogger(__name__)

GENERATIONS, POPULATION = 10, 12
"""Of the search (CMA-ES, Hansen 2016)."""
SPREAD = 0.5
"""First standard deviation of the constants' logarithms."""
USUAL = 0.004
"""Weight of the squared distance of the logarithms from the usual constants."""
FARTHEST = 0.3
"""Metres of error above which a map counts as lost rather than as wrong."""
SHRUNK = 0.85
"""What the registered maps say themselves of how far cloth went: their slope over true cloth (docs/log)."""
WIDTHS = ("slack", "give")
"""Constants that start from 1."""
LIMITS = {"core": 0.95, "friction": 3.0, "slack": 2.0, "give": 2.0}
"""Largest values of constants."""


def fit_prior(
    avatar: Avatar,
    maps: RegisteredMaps,
    signals: Mapping[str, DrivingSignal],
    rest_frames: Sequence[tuple[str, int]],
    seed: int,
) -> None:
    """Give the avatar's motion prior its rest shapes and, where there are registered maps, its constants.

    All workers must call it together; they share the work and come to the same result.

    Args:
        avatar: With a template that is fitted.
        maps: The registered maps.
        signals: Driving signals of the sequences.
        rest_frames: Sequence and frame of still frames, in which the cloth is taken to hang at rest.
        seed: Of the search.
    """
    avatar.place_prior()
    if avatar.prior is None:
        return
    first = 0
    for garment in avatar.prior.garments:
        points = avatar.garment_control_points()[first : first + len(garment.axes)]
        first += len(garment.axes)
        _Fit(avatar, garment, points, maps, signals, rest_frames).run(seed)


@dataclasses.dataclass(frozen=True)
class _Clip:
    """A sequence with registered maps."""

    stage: Stage
    target: Float[Tensor, "f g 3"]
    """The maps at the garment's control points, along their axes."""


class _Fit:
    """The search for the constants of one garment."""

    def __init__(
        self,
        avatar: Avatar,
        garment: GarmentPrior,
        points: Tensor,
        maps: RegisteredMaps,
        signals: Mapping[str, DrivingSignal],
        rest_frames: Sequence[tuple[str, int]],
    ) -> None:
        # The search is in main memory, where the solver works.
        self.fitted, self.garment, self.fps = garment, copy.deepcopy(garment).cpu(), avatar.fps
        self.simulation: ClothSimulation = garment.simulation(avatar.body)
        # One pose of each of a few sequences: cloth hangs a little differently in each.
        still = dict(reversed([(name, frame) for name, frame in rest_frames]))
        self.rest = [
            self.simulation.stage(signals[name].steady[frame : frame + 1].cpu())
            for name, frame in list(still.items())[:4]
        ]
        self.clips = [
            _Clip(
                self.simulation.stage(signals[name].steady[fitted].cpu()),
                maps.offsets[name][fitted][:, points].cpu(),
            )
            for name, clip in sorted(maps.clips.items())
            if (count := int(maps.fitted[name])) > 1
            for fitted in (slice(clip.start, clip.start + count),)
        ]

    def run(self, seed: int) -> None:
        """Search, and set the garment's constants, how it hangs, and how far it is trusted."""
        best = ClothConstants()
        if self.clips:
            # Here, not above: it brings scipy.stats and matplotlib, a second of every process that trains.
            import cma

            options = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9}
            search = cma.CMAEvolutionStrategy(np.zeros(len(best.to_vector())), SPREAD, options)
            for _ in range(GENERATIONS):
                tried = search.ask()
                search.tell(tried, self._losses(tried))
            found = [np.zeros(len(best.to_vector())), search.result.xbest, search.result.xfavorite]
            best = constants_at(found[int(np.argmin(self._losses(found)))])
        offsets, hanging = self._simulate(best)
        trust = self._trust(offsets)
        self.fitted.constants.copy_(torch.from_numpy(best.to_vector()))
        self.fitted.hanging.copy_(hanging)
        self.fitted.trust.copy_(trust)
        LOGGER.info("The garment's cloth: %s; trust %s", best, trust.numpy().round(2))

    def _losses(self, tried: Sequence[np.ndarray]) -> list[float]:
        """Return the loss of each of some constants; each worker computes its share."""
        losses = torch.zeros(len(tried), dtype=torch.float64)
        for index in range(workers.rank(), len(tried), workers.world_size()):
            unusual = USUAL * float(np.square(tried[index]).sum())
            losses[index] = self._loss(constants_at(tried[index])) + unusual
        workers.all_reduce([losses])
        return losses.tolist()

    def _loss(self, constants: ClothConstants) -> float:
        offsets, _ = self._simulate(constants)
        errors = [
            (offset - clip.target).norm(dim=-1).clamp_max(FARTHEST).mean()
            / clip.target.norm(dim=-1).mean().clamp_min(1e-3)
            for offset, clip in zip(offsets, self.clips, strict=True)
        ]
        return float(torch.stack(errors).mean())

    def _simulate(
        self, constants: ClothConstants
    ) -> tuple[list[Float[Tensor, "_ g 3"]], Float[Tensor, "n 3"]]:
        """Return each clip's offsets at the control points, and how the cloth hangs at rest."""
        simulation, fabric = self.simulation, self.simulation.fabric(constants)
        hanging = hang(simulation, fabric, self.rest, self.fps)
        return [
            self.garment.along_axes(simulation.displacements(clip.stage, fabric, self.fps, hanging) - hanging)
            for clip in self.clips
        ], hanging

    def _trust(self, offsets: Sequence[Float[Tensor, "_ g 3"]]) -> Float[Tensor, " r"]:
        """Return by row the share of the simulated offsets that explains the maps best; 1 where none tell."""
        rows, columns = self.garment.rest.shape[:2]
        if not self.clips:
            return torch.ones(rows)
        # How much of each row of the grid is in each control point.
        of_row = self.garment.sampling(torch.eye(rows).repeat_interleave(columns, 0))
        simulated, target = torch.cat(list(offsets)), torch.cat([clip.target for clip in self.clips])
        explained = (simulated * target).sum((0, 2)) @ of_row
        size = simulated.square().sum((0, 2)) @ of_row
        share = (explained / size.clamp_min(1e-9) / SHRUNK).clamp(0, 1)
        return torch.where(size > 0, share, torch.ones(rows))


def constants_at(logarithms: Float[np.ndarray, " k"]) -> ClothConstants:
    """Return the constants whose logarithms are so far from the usual ones; of widths, of what exceeds 1."""
    factors = np.exp(np.clip(logarithms, -6, 6))
    usual = dataclasses.asdict(ClothConstants())
    values = {}
    for (name, value), factor in zip(usual.items(), factors, strict=True):
        least = 1.0 if name in WIDTHS else 0.0
        values[name] = min(least + (value - least) * float(factor), LIMITS.get(name, np.inf))
    return ClothConstants(**values)
