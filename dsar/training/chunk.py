"""One update's worth of work: a chunk of K frames of several rollouts, rendered and compared."""

import dataclasses
import os
from collections import defaultdict, deque
from collections.abc import Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.avatar.avatar import Avatar
from dsar.avatar.input_maps import InputMaps
from dsar.avatar.mirror import Mirror, mirror_motion
from dsar.config import TrainConfig
from dsar.errors import TrainingError
from dsar.network import STREAMS, NetworkOutput, NetworkState, Stream
from dsar.raster import rasterize, reduced_dilation
from dsar.training.losses import TemporalRecord, image_loss, registered_loss, spatial_loss, temporal_losses
from dsar.training.rest import RestOffsets
from dsar.training.rollouts import RolloutBatch, RolloutCursor
from dsar.training.schedule import WHOLE_CLIP, ScheduleState
from dsar.training.targets import Target, TargetLoader
from dsar.types import Capture, Gaussians

TEMPLATE_FRAMES = 8
"""Frames of an update of the template alone."""
_NO_MAPS = (range(0),)


@dataclass(frozen=True)
class UpdateMetrics:
    """What an update reports."""

    loss: float
    """Total loss per rendered view."""
    mse: float | None
    """Mean squared colour error per view, over the crop and a random background; None without images."""
    gradients: dict[str, float] | None = None
    """Norms of the regularisers' gradients by the first convolution as shares of L_render's; if asked for."""


@dataclass(frozen=True)
class _Step:
    """One frame of every rollout."""

    cursors: list[RolloutCursor]
    """Where each rollout stands."""
    motion_window: Float[Tensor, "b t j 4 4"]
    """Each one's motion, as it was filmed."""
    driving_window: Float[Tensor, "b t j 4 4"]
    """The same, or its mirror image."""
    observed: InputMaps
    """The network's input, of what was seen."""
    output: NetworkOutput
    """The network's answer to what was seen."""
    unmirrored_output: NetworkOutput
    """The same turned back to what was filmed."""


class ChunkTrainer:
    """Holds a worker's rollouts and turns each chunk of them into gradients."""

    def __init__(
        self,
        config: TrainConfig,
        capture: Capture,
        avatar: Avatar,
        clips: dict[str, range],
        lpips: nn.Module | None,
    ) -> None:
        self.config, self.avatar, self.lpips = config, avatar, lpips
        self.loader = TargetLoader(capture, max(1, (os.cpu_count() or 1) // config.workers))
        self.signals = {name: avatar.driving_signal(capture.motions[name]) for name in clips}
        self.rollouts = RolloutBatch(
            clips, config.schedule.rollouts_per_worker, config.schedule.mirrored_fraction
        )
        self.mirror = Mirror(avatar.control) if config.schedule.mirrored_fraction else None
        self.state: NetworkState = avatar.initial_state(config.schedule.rollouts_per_worker)
        self.registered: Mapping[str, tuple[Collection[int], Tensor]] = {}
        """Frames that have a registered map, and the maps at the control points, by sequence."""
        self.records: deque[TemporalRecord] = deque(maxlen=3)
        self.speeds: deque[Tensor] = deque(maxlen=max(2, config.model.window))
        """Motion magnitudes of the window's frames, oldest first."""

    def backward_template(self, rng: np.random.Generator, rest: RestOffsets, reduction: int) -> UpdateMetrics:
        """Back-propagate views of the template in the shapes it has in still frames."""
        chosen, views = rng.choice(len(rest.frames), TEMPLATE_FRAMES), self.config.schedule.views
        frames = [rest.frames[index] for index in chosen]
        targets = [self.loader.request(rng, name, frame, reduction, views) for name, frame in frames]
        count = max(sum(map(len, targets)), 1)
        loss, mse = count * rest.loss(self.avatar, self.config.loss), torch.zeros(())
        for index, (name, frame), some in zip(chosen, frames, targets, strict=True):
            output = rest.output(self.avatar, int(index))
            gaussians = self.avatar.gaussians(self.signals[name].windows[[frame]], output)[0]
            view = self._views(rng, gaussians, some, reduction)
            loss, mse = loss + view[0], mse + view[1]
        return self._backward(loss, mse, count)

    def backward_pretraining(self, rng: np.random.Generator) -> UpdateMetrics:
        """Advance every rollout by K frames and back-propagate the distance to the registered maps."""
        self.avatar.unhide_covered_texels()
        loss = torch.zeros(())
        for _ in range(self.config.schedule.chunk_frames):
            step = self._step(*self.rollouts.next_frames(rng, WHOLE_CLIP), streams=STREAMS)
            loss = loss + self._registered_distance(step)
        self._detach_state()
        return self._backward(loss, None, self.config.schedule.chunk_frames)

    def backward_chunk(
        self, rng: np.random.Generator, now: ScheduleState, *, probe: bool = False
    ) -> UpdateMetrics:
        """Advance every rollout by K frames and back-propagate through them, the whole body shown.

        With `probe`, report how the gradients of the losses compare.
        """
        self.avatar.unhide_covered_texels()
        schedule = self.config.schedule
        streams = STREAMS if now.stage == "autoregressive" else ()
        losses: dict[str, Tensor] = defaultdict(lambda: torch.zeros(()))
        mse, count = torch.zeros(()), 0
        for _ in range(schedule.chunk_frames):
            cursors, fresh = self.rollouts.next_frames(rng, now.max_rollout_frames)
            shown = [i for i in range(len(cursors)) if rng.random() < schedule.rendered_fraction]
            targets = [
                self.loader.request(rng, cursors[i].sequence, cursors[i].frame, now.reduction, schedule.views)
                for i in shown
            ]
            step = self._step(cursors, fresh, streams=streams)
            answers = step.unmirrored_output.select(shown)
            gaussians = self.avatar.gaussians(step.motion_window[shown], answers) if shown else []
            for each, some in zip(gaussians, targets, strict=True):
                view = self._views(rng, each, some, now.reduction)
                losses["render"] = losses["render"] + view[0]
                mse, count = mse + view[1], count + len(some)
            regularisers = {"spatial": self._spatial(step.output)}
            if self.registered:
                regularisers["registered"] = self.config.loss.registered * self._registered_distance(step)
            if streams:
                regularisers |= self._temporal(step)
            for name, loss in regularisers.items():
                losses[name] = losses[name] + loss * sum(map(len, targets))
        self._detach_state()
        gradients = self._compare_gradients(losses) if probe else None
        done = self._backward(torch.stack(list(losses.values())).sum(), mse, max(count, 1))
        return dataclasses.replace(done, gradients=gradients)

    def _step(
        self, cursors: list[RolloutCursor], fresh: list[bool], *, streams: Collection[Stream]
    ) -> "_Step":
        """Advance every rollout by one frame, some of them afresh."""
        self.state = self.state.restart(torch.tensor(fresh))
        seen = motion_window = torch.stack([self.signals[p.sequence].windows[p.frame] for p in cursors])
        mirrored = torch.tensor([cursor.mirrored for cursor in cursors])
        if self.mirror is not None:
            seen = torch.where(
                mirrored[:, None, None, None, None], mirror_motion(motion_window), motion_window
            )
        output, self.state, observed = self.avatar.forward_frame(seen, self.state, streams=streams)
        answer = self.mirror.unmirror(output, mirrored) if self.mirror is not None else output
        cursors = [dataclasses.replace(cursor) for cursor in cursors]
        self.rollouts.advance()
        return _Step(cursors, motion_window, seen, observed, output, answer)

    def _detach_state(self) -> None:
        """Cut what the rollouts carry on from the graph of this chunk."""
        self.state = self.state.detach()
        for _ in range(len(self.records)):
            self.records.append(self.records.popleft().detach())

    def state_dict(self) -> tuple[dict[str, Tensor], list[dict[str, str | int]]]:
        """Return what must survive a restart: the rollouts' state as tensors, and their cursors."""
        tensors = {"fresh": self.state.fresh, "motion": self.state.motion}
        tensors |= {"offsets": self.state.offsets, "memory": self.state.memory}
        tensors |= {f"window.{i}": level for i, level in enumerate(self.state.window)}
        for i, record in enumerate(self.records):
            tensors |= {f"record.{i}.offset": record.output.offset, f"record.{i}.posed": record.posed}
            tensors[f"record.{i}.appearance"] = record.output.appearance
            tensors |= {f"record.{i}.feature.{k}": f for k, f in enumerate(record.output.features)}
        tensors |= {f"speed.{i}": speed for i, speed in enumerate(self.speeds)}
        cursors = [vars(cursor) for cursor in self.rollouts.cursors if cursor is not None]
        return tensors, cursors

    def load_state_dict(self, tensors: dict[str, Tensor], cursors: list[dict[str, str | int]]) -> None:
        """Restore what `state_dict` returned."""
        levels = len(self.state.window)
        self.state = NetworkState(
            fresh=tensors["fresh"],
            window=tuple(tensors[f"window.{i}"] for i in range(levels)),
            motion=tensors["motion"],
            offsets=tensors["offsets"],
            memory=tensors["memory"],
        )
        self.records.clear()
        while f"record.{len(self.records)}.offset" in tensors:
            prefix = f"record.{len(self.records)}"
            features = tuple(tensors[f"{prefix}.feature.{k}"] for k in range(len(self.config.model.channels)))
            output = NetworkOutput(tensors[f"{prefix}.offset"], tensors[f"{prefix}.appearance"], features)
            self.records.append(TemporalRecord(output, tensors[f"{prefix}.posed"]))
        self.speeds.clear()
        while f"speed.{len(self.speeds)}" in tensors:
            self.speeds.append(tensors[f"speed.{len(self.speeds)}"])
        if cursors:
            self.rollouts.cursors[:] = [RolloutCursor(**cursor) for cursor in cursors]  # pyright: ignore[reportArgumentType]

    def _views(
        self, rng: np.random.Generator, gaussians: Gaussians, targets: list[Future[Target]], reduction: int
    ) -> tuple[Tensor, Tensor]:
        """Return summed loss and squared error of some views on a random background."""
        loss, mse = torch.zeros(()), torch.zeros(())
        for target in (each.result() for each in targets):
            background = torch.from_numpy(rng.random(3, np.float32))
            output = rasterize(
                gaussians, target.camera, background=background, dilation=reduced_dilation(reduction)
            )
            one, error = image_loss(output, target, background, self.config.loss, self.lpips)
            loss, mse = loss + one, mse + error
        return loss, mse

    def _spatial(self, output: NetworkOutput) -> Tensor:
        offsets = self.avatar.gather_control_points(output.offset)
        return self.config.loss.spatial * spatial_loss(offsets, self.avatar.control.edges)

    def _registered_distance(self, step: "_Step") -> Tensor:
        """Return the mean distance, cm, to the registered maps; frames without one count as reached."""
        known = [p.frame in self.registered.get(p.sequence, _NO_MAPS)[0] for p in step.cursors]
        answers = self.avatar.gather_control_points(step.unmirrored_output.offset)
        wanted = [
            self.registered[cursor.sequence][1][cursor.frame] if has else torch.zeros_like(answers[0])
            for has, cursor in zip(known, step.cursors, strict=True)
        ]
        distances = registered_loss(answers, torch.stack(wanted))
        return (distances * torch.tensor(known)).mean()

    def _compare_gradients(self, losses: Mapping[str, Tensor]) -> dict[str, float] | None:
        weight, norms = self.avatar.network.encoder.pyramid.first.weight, {}
        for name, loss in losses.items():
            # A loss that is switched off, or of frames without a past, is a constant.
            if loss.requires_grad:
                (gradient,) = torch.autograd.grad(loss, weight, retain_graph=True, materialize_grads=True)
                norms[name] = float(gradient.norm())
        render = norms.pop("render", 0.0)
        return {name: norm / render for name, norm in norms.items()} if render else None

    def _temporal(self, step: "_Step") -> dict[str, Tensor]:
        """Append this frame's record and return the temporal losses against the frames before it."""
        avatar = self.avatar
        posed = avatar.deformed_control_points(step.driving_window, step.output)
        self.records.append(TemporalRecord(step.output, posed))
        self.speeds.append(step.observed.magnitude)
        ages = [cursor.age for cursor in step.cursors]
        occupied, loss = avatar.network.occupied, self.config.loss
        return temporal_losses(
            list(self.records), list(self.speeds), ages, occupied, avatar.control.cells, loss
        )

    def _backward(self, loss: Tensor, mse: Tensor | None, count: int) -> UpdateMetrics:
        loss = loss / count
        if not loss.isfinite():
            raise TrainingError(
                f"the loss is {float(loss.detach())}; "
                f"first tensor that is not finite: {self._first_not_finite()}"
            )
        loss.backward()
        return UpdateMetrics(float(loss.detach()), float(mse) / count if mse is not None else None)

    def _first_not_finite(self) -> str:
        named = [
            *self.avatar.named_parameters(),
            *((f"state.{k}", v) for k, v in self.state_dict()[0].items()),
        ]
        return next((name for name, value in named if not value.isfinite().all()), "the rendered image")
