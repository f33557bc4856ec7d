"""The watchdog: replaces frames of a rollout that would break.

A frame breaks where the output is not finite, far larger than any of training, or trembles as none of
training does. Then the network's memory cannot be trusted: it is dropped, and the frame is made of the
pose alone, as the first frame of a motion is. Where that breaks, too, it is the skinned template. So that
nothing pops, what is shown glides there from the frame before. An avatar's motion prior is beneath all of it.

Only the frame itself and those before it decide. Without a finding the output is passed on as it is.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.guard_limits import BREAKING_MARGIN, FAR_MARGIN, GuardLimits, Jitter
from dsar.avatar.guards import Guard
from dsar.network import NetworkOutput
from dsar.types import GuardedFrame

REPLACING = frozenset({Guard.FINITE, Guard.SIZE, Guard.JITTER})
"""Guards that replace a frame."""
BLEND_SECONDS = 0.2
"""How long what is shown takes to be again what the network says."""


@dataclass(frozen=True)
class WatchdogState:
    """What the watchdog knows after a frame; no later frame changes it."""

    jitter: Jitter
    shown: NetworkOutput | None = None
    """The frame as it was shown."""
    held: float = 0.0
    """Share of the frame before in it."""


@runtime_checkable
class PoseOnly(Protocol):
    """Makes one frame of its pose alone; both ways leave the network without memory of any frame before."""

    def restart(self) -> NetworkOutput:
        """Return what the network makes of this frame as a first one."""
        ...

    def template(self) -> NetworkOutput:
        """Return the output of the skinned template."""
        ...


class Watchdog:
    """Guards one rollout; frames are passed to it in their order."""

    def __init__(self, limits: GuardLimits, fps: float, device: torch.device) -> None:
        """Begin before the first frame at a rate."""
        self.limits = limits.to(device)
        self._step = 1 / max(round(BLEND_SECONDS * fps), 1)
        self._beginning = WatchdogState(Jitter.at_rate(fps))
        self.state = self._beginning
        """To keep and to set again when a rollout goes back."""

    def forget(self) -> None:
        """Begin anew: another shot is cut to."""
        self.state = self._beginning

    def watch(
        self,
        maps: Float[Tensor, "1 c h w"],
        output: NetworkOutput,
        pose_only: "PoseOnly",
    ) -> tuple[NetworkOutput, GuardedFrame | None]:
        """Return what a frame is to show, and what was found, if anything was.

        Args:
            maps: The standardised input maps.
            output: What the network made of them, without the motion prior: that is a simulation, which may
                move a garment further than in training where the motion is wilder.
            pose_only: Makes the frame without what came before it.
        """
        found, jitter = self._find(maps, output)
        held = max(self.state.held - self._step, 0.0)
        if found.keys() & REPLACING:
            output = pose_only.restart()
            # A number that is none is within no limit.
            if not float(self.limits.size(output)) <= BREAKING_MARGIN:
                output = pose_only.template()
            # The step to a sound frame is no trembling of it.
            held, jitter = 1 - self._step, self._beginning.jitter.step(output.offset.clone(), 0.0)
        shown = self.state.shown
        # Rounding leaves less than any step.
        if shown is None or held < self._step / 2:
            held = 0.0
        else:
            output = _blend(output, shown, held)
        shown = NetworkOutput(output.offset.clone(), output.appearance.clone(), ())
        self.state = WatchdogState(jitter, shown, held)
        exceeded = {str(guard): value for guard, value in sorted(found.items())}
        return output, GuardedFrame(exceeded, held) if exceeded or held else None

    def _find(
        self, maps: Float[Tensor, "1 c h w"], output: NetworkOutput
    ) -> tuple[dict[Guard, float], Jitter]:
        """Return how many times training's largest each value beyond its limit is, and the jitter now."""
        offset, jitter = output.offset.clone(), self.state.jitter
        # One wait for a GPU, not three.
        values = [self.limits.distance(maps), self.limits.size(output), jitter.change(offset)]
        distance, size, change = torch.stack(values).tolist()
        found = {Guard.FAR: distance if math.isfinite(distance) else math.inf}
        if math.isfinite(size):
            jitter = jitter.step(offset, change)
            found |= {Guard.SIZE: size, Guard.JITTER: jitter.size / self.limits.jitter}
        else:
            found[Guard.FINITE] = math.inf
        margins = {Guard.FAR: FAR_MARGIN}
        beyond = {
            guard: value for guard, value in found.items() if value > margins.get(guard, BREAKING_MARGIN)
        }
        return beyond, jitter


def _blend(output: NetworkOutput, before: NetworkOutput, share: float) -> NetworkOutput:
    """Return an output that is to a share the one of the frame before."""
    offset = torch.lerp(output.offset, before.offset, share)
    return NetworkOutput(offset, torch.lerp(output.appearance, before.appearance, share), output.features)
