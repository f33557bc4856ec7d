"""The simulation of one tube of cloth on a body that moves: a whole motion at once, or part by part."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from numpy import ndarray
from torch import Tensor

from dsar.body.skinning import blend_transforms
from dsar.dynamics.cloth import ClothConstants, Constraints, build_constraints
from dsar.dynamics.collider import BodyCollider
from dsar.dynamics.solver import simulate

STEPS_PER_SECOND = 240
"""Steps of the solver; a frame takes a whole number of them, and at least one."""
SETTLING_SECONDS = 1.5
"""Time for which the cloth hangs in a motion's first pose before the motion begins."""
LEAST_VOLUME = 0.25
"""Share of its volume to which skin weights that blend opposed turns may flatten space. Below, as beneath a
leg that is raised high, a way from home is shortened in proportion; it would grow without bound."""
_CHUNK = 256
"""Frames whose body is posed at once."""


@dataclass(frozen=True)
class Fabric:
    """A kind of cloth in the shape of one garment."""

    constants: ClothConstants
    constraints: Constraints


@dataclass(frozen=True)
class Stage:
    """What a motion does around the cloth, by frame: it is the same for every kind of cloth."""

    home: Float32[ndarray, "f n 3"]
    """Where skinning carries the resting garment, world metres."""
    body: Float32[ndarray, "f b 3"]
    """The collider's points, world metres."""
    normals: Float32[ndarray, "f b 3"]
    """Their outward unit normals."""
    turns: Float[Tensor, "f n 3 3"]
    """The linear parts of the transforms that carry the cloth home."""

    def held(self, frames: int) -> "Stage":
        """Return the first frame for so many frames."""
        home, body, normals = (
            np.repeat(array[:1], frames, 0) for array in (self.home, self.body, self.normals)
        )
        return Stage(home, body, normals, self.turns[:1].expand(frames, -1, -1, -1))


@dataclass(frozen=True)
class ClothState:
    """What the cloth is at one moment."""

    points: Float32[ndarray, "n 3"]
    """Positions, world metres."""
    velocities: Float32[ndarray, "n 3"]
    """Metres per second."""
    nearest: Int32[ndarray, " n"]
    """Body point nearest to each."""

    def copy(self) -> "ClothState":
        """Return a copy that later steps do not touch."""
        return ClothState(self.points.copy(), self.velocities.copy(), self.nearest.copy())


class ClothSimulation:
    """A resting garment and the body around it; it keeps no state of its own."""

    def __init__(
        self, collider: BodyCollider, rest: Float[Tensor, "r c 3"], weights: Float[Tensor, "r c j"]
    ) -> None:
        """Prepare to simulate.

        Args:
            collider: The body around it.
            rest: Its points in the body's rest pose, rows from the top, columns around, metres.
            weights: Skin weights that carry them home; the first row is fixed to its home.
        """
        self.collider, self.shape = collider, (rest.shape[0], rest.shape[1])
        self.rest, self.weights = rest.flatten(0, 1), weights.flatten(0, 1)

    def fabric(self, constants: ClothConstants) -> Fabric:
        """Return the garment in a kind of cloth."""
        return Fabric(constants, build_constraints(self.rest.numpy().reshape(*self.shape, 3), constants))

    def stage(self, transforms: Float[Tensor, "f j 4 4"]) -> Stage:
        """Return what a motion, T_world_rest of the body's joints, does around the cloth."""
        blended = blend_transforms(self.weights, transforms)
        home = (blended[..., :3] * self.rest[:, None]).sum(-1) + blended[..., 3]
        body, normals = self.collider.pose(transforms)
        return Stage(
            home.float().numpy(), body.float().numpy(), normals.float().numpy(), blended[..., :3].float()
        )

    def begin(
        self, stage: Stage, fabric: Fabric, fps: float, hanging: Float[Tensor, "n 3"] | None = None
    ) -> ClothState:
        """Return the state of cloth that has hung for a while around the first frame.

        Args:
            stage: The motion.
            fabric: The cloth.
            fps: Frames a second.
            hanging: Displacement from home, in the frame of the body at rest, that it is let go in; metres.
        """
        start = stage.home[0].copy()
        if hanging is not None:
            start += (stage.turns[0] @ hanging.float()[..., None])[..., 0].numpy()
        nearest = ((start[:, None] - stage.body[0]) ** 2).sum(-1).argmin(1).astype(np.int32)
        state = ClothState(start, np.zeros_like(start), nearest)
        _, state = self.advance(state, stage.held(max(2, round(SETTLING_SECONDS * fps))), fabric, fps)
        return ClothState(state.points, np.zeros_like(start), state.nearest)

    def advance(
        self, state: ClothState, stage: Stage, fabric: Fabric, fps: float
    ) -> tuple[Float32[ndarray, "e n 3"], ClothState]:
        """Return the cloth's points, world metres, in all frames but the first, and its state in the last.

        The state that is given is the first frame's.
        """
        state, constraints = state.copy(), fabric.constraints
        points = np.empty((len(stage.home) - 1, *state.points.shape), np.float32)
        simulate(
            state.points, state.velocities, state.nearest,
            stage.home, stage.body, stage.normals, self.collider.neighbours,
            constraints.ends, constraints.lengths, constraints.compliances, constraints.sides,
            fabric.constants.of_motion, self.shape, max(1, round(STEPS_PER_SECOND / fps)), float(fps), points,
        )  # fmt: skip
        return points, state

    def displacements(
        self, stage: Stage, fabric: Fabric, fps: float, hanging: Float[Tensor, "n 3"] | None = None
    ) -> Float[Tensor, "f n 3"]:
        """Return the cloth's way from home in every frame, in the frame of the body at rest, metres.

        Before the first frame the body has stood in it, and cloth hung around it (see `begin`).
        """
        state = self.begin(stage, fabric, fps, hanging)
        rest, _ = self.advance(state, stage, fabric, fps)
        return displace(np.concatenate([state.points[None], rest]), stage)

    def follow(
        self,
        transforms: Float[Tensor, "f j 4 4"],
        fabric: Fabric,
        fps: float,
        hanging: Float[Tensor, "n 3"] | None = None,
    ) -> Float[Tensor, "f n 3"]:
        """Return `displacements` through a motion of any length, whose body is posed part by part."""
        first = self.stage(transforms[:1])
        state = self.begin(first, fabric, fps, hanging)
        parts = [displace(state.points[None], first)]
        for start in range(0, len(transforms) - 1, _CHUNK):
            stage = self.stage(transforms[start : start + _CHUNK + 1])
            points, state = self.advance(state, stage, fabric, fps)
            parts.append(displace(points, stage))
        return torch.cat(parts)


def displace(points: Float32[ndarray, "e n 3"], stage: Stage) -> Float[Tensor, "e n 3"]:
    """Return the way from home of points in a motion's last frames, in the frame of the body at rest."""
    count = len(points)
    way = torch.from_numpy(points - stage.home[-count:])
    # Cramer's rule: a third of the time of a library's solver for as many small systems.
    first, second, third = stage.turns[-count:].unbind(-2)
    across = torch.linalg.cross(second, third)
    ways = way[..., :1] * across
    ways = ways + way[..., 1:2] * torch.linalg.cross(third, first)
    ways = ways + way[..., 2:] * torch.linalg.cross(first, second)
    return ways / (first * across).sum(-1, keepdim=True).clamp_min(LEAST_VOLUME)
