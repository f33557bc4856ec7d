"""One update's worth of work: a chunk of K frames of several rollouts, rendered and compared."""

import dataclasses
import math
import os
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from dsar.avatar.driving import DrivingSignal
from dsar.avatar.mirror import Mirror
from dsar.config import TrainConfig
from dsar.devices import send
from dsar.errors import TrainingError
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.training import workers
from dsar.training.driving_maps import DrivingFrames, DrivingMaps
from dsar.training.kept_views import KeptViews
from dsar.training.losses import CENTIMETRES, registered_loss, spatial_loss
from dsar.training.report import UpdateMetrics
from dsar.training.rollouts import RolloutCursor
from dsar.training.schedule import WHOLE_CLIP, ScheduleState
from dsar.training.state import TrainingState
from dsar.training.targets import TargetLoader
from dsar.training.temporal_losses import TemporalRecord, temporal_losses
from dsar.training.view_batch import ViewBatch
from dsar.types import Gaussians

TEMPLATE_FRAMES = 8
"""Frames of an update of the template alone."""


@dataclass(frozen=True)
class _Step:
    """One frame of every rollout."""

    cursors: list[RolloutCursor]
    """Where each rollout stood."""
    driving: DrivingFrames
    """What drives the network: of that motion or its mirror image."""
    output: NetworkOutput
    """The network's output."""
    unmirrored_output: NetworkOutput
    """The same as the filmed motion has it."""


class ChunkTrainer:
    """Turns each chunk of a worker's rollouts into gradients of its avatar."""

    def __init__(
        self,
        config: TrainConfig,
        views: KeptViews,
        state: TrainingState,
        signals: Mapping[str, DrivingSignal],
        lpips: nn.Module | None,
    ) -> None:
        """Prepare to train.

        Args:
            config: The settings of the run.
            views: Its images.
            state: What is trained; rollouts and what they remember go on with every chunk.
            signals: Driving signals of the sequences.
            lpips: The LPIPS network, where it is used.
        """
        self.config, self.state, self.avatar = config, state, state.avatar
        self.lpips = lpips
        avatar, self.device = state.avatar, state.avatar.device
        threads = max(1, (os.cpu_count() or 1) // workers.local_count(config.workers))
        self.loader = TargetLoader(views, threads)
        self._shown = False
        self.mirror = Mirror(avatar.control) if config.schedule.mirrored_fraction else None
        self.drive(signals)

    def drive(self, signals: Mapping[str, DrivingSignal]) -> None:
        """Take the driving signals of the sequences, and anew once the motion prior is fitted."""
        self.signals = signals
        self.driving = DrivingMaps(self.avatar, signals, mirrored=self.mirror is not None)

    def backward_template(self, rng: np.random.Generator, reduction: int) -> UpdateMetrics:
        """Back-propagate views of the template in the shapes it has in still frames."""
        rest, views = self.state.rest, self._view_batch(rng, reduction)
        chosen = rng.choice(len(rest.frames), TEMPLATE_FRAMES)
        frames = [rest.frames[index] for index in chosen]
        count = max(views.request(frames), 1)
        windows = torch.stack([self.signals[name].windows[frame, :1] for name, frame in frames])
        outputs = rest.output(self.avatar, send(torch.from_numpy(chosen), self.device))
        gaussians = self.avatar.gaussians(windows, outputs)
        loss, mse = views.compare(gaussians, self.config.loss, self.lpips)
        return self._backward(loss + count * rest.loss(self.avatar, self.config.loss), mse, count)

    def backward_pretraining(self, rng: np.random.Generator) -> UpdateMetrics:
        """Step every rollout by K frames and back-propagate the distance to the registered maps."""
        self._show_whole_body()
        loss = self._zero()
        for _ in range(self.config.schedule.chunk_frames):
            step = self._step(*self.state.rollouts.next_frames(rng, WHOLE_CLIP), streams=STREAMS)
            loss = loss + self._registered_distance(step) + self._residual(step)
        self._detach_state()
        return self._backward(loss, None, self.config.schedule.chunk_frames)

    def backward_chunk(
        self, rng: np.random.Generator, schedule_state: ScheduleState, *, probe: bool = False
    ) -> UpdateMetrics:
        """Step every rollout by K frames and back-propagate L_total (paper equation 22).

        The whole body is shown. L_total has losses over space and to registered maps besides. With `probe`,
        report how the gradients of the losses compare.
        """
        self._show_whole_body()
        schedule = self.config.schedule
        streams = STREAMS if schedule_state.stage == "autoregressive" else ()
        losses: dict[str, Tensor] = defaultdict(self._zero)
        views, gaussians = self._view_batch(rng, schedule_state.reduction), list[Gaussians]()
        for _ in range(schedule.chunk_frames):
            cursors, fresh = self.state.rollouts.next_frames(rng, schedule_state.max_rollout_frames)
            rendered = [i for i in range(len(cursors)) if rng.random() < schedule.rendered_fraction]
            added = views.request((cursors[i].sequence, cursors[i].frame) for i in rendered)
            step = self._step(cursors, fresh, streams=streams)
            gaussians += self._pose(step, rendered) if rendered else []
            for name, loss in self._regularizers(step, streams).items():
                losses[name] = losses[name] + loss * added
        self._detach_state()
        losses["render"], mse = views.compare(gaussians, self.config.loss, self.lpips)
        gradients = self._compare_gradients(losses) if probe else None
        metrics = self._backward(torch.stack(list(losses.values())).sum(), mse, max(len(views), 1))
        return dataclasses.replace(metrics, gradients=gradients)

    def _show_whole_body(self) -> None:
        # Asked once, for the answer makes the host wait for a GPU.
        if not self._shown:
            self.avatar.unhide_covered_texels()
            self._shown = True

    def _step(self, cursors: list[RolloutCursor], fresh: list[bool], *, streams: Collection[Stream]) -> _Step:
        """Step every rollout by one frame, some of them afresh."""
        state = self.state
        state.network = state.network.restart(send(torch.tensor(fresh), self.device))
        driving = self.driving.gather(cursors)
        output, state.network = self.avatar.network(
            driving.maps, driving.magnitude, state.network, streams=streams
        )
        output = dataclasses.replace(output, offset=output.offset + driving.base)
        mirrored = send(torch.tensor([cursor.mirrored for cursor in cursors]), self.device)
        unmirrored = self.mirror.unmirror(output, mirrored) if self.mirror is not None else output
        cursors = [dataclasses.replace(cursor) for cursor in cursors]
        state.rollouts.advance()
        return _Step(cursors, driving, output, unmirrored)

    def _pose(self, step: _Step, rollouts: list[int]) -> list[Gaussians]:
        """Return the posed Gaussians of some rollouts, as they were filmed."""
        places = [step.cursors[index] for index in rollouts]
        windows = torch.stack([self.signals[c.sequence].windows[c.frame, :1] for c in places])
        which = send(torch.tensor(rollouts), self.device)
        return self.avatar.gaussians(windows, step.unmirrored_output.select(which))

    def _detach_state(self) -> None:
        """Cut what the rollouts carry on from the graph of this chunk."""
        self.state.network = self.state.network.detach()
        self.state.history.detach()

    def _view_batch(self, rng: np.random.Generator, reduction: int) -> ViewBatch:
        return ViewBatch(self.loader, rng, reduction, self.config.schedule.views)

    def _regularizers(self, step: _Step, streams: Collection[Stream]) -> dict[str, Tensor]:
        """Return the weighted losses of a frame that need no image, by name."""
        losses = {"spatial": self._spatial(step.output)}
        if self.state.registered.usable:
            losses["registered"] = self.config.loss.registered * self._registered_distance(step)
        if self.avatar.prior is not None:
            losses["residual"] = self.config.loss.registered * self._residual(step)
        return losses | self._temporal(step) if streams else losses

    def _spatial(self, output: NetworkOutput) -> Tensor:
        offsets = self.avatar.gather_control_points(output.offset)
        return self.config.loss.spatial * spatial_loss(offsets, self.avatar.control.edges)

    def _registered_distance(self, step: _Step) -> Tensor:
        """Return the mean distance, cm, to the registered maps; frames without one count as reached."""
        offsets = self.avatar.gather_control_points(step.unmirrored_output.offset)
        maps, has_map = self.state.registered.targets(step.cursors)
        return (registered_loss(offsets, maps) * has_map).mean()

    def _residual(self, step: _Step) -> Tensor:
        """Return what it costs to move the garments away from the motion prior."""
        if self.avatar.prior is None:
            return self._zero()
        residual = self.avatar.gather_control_points(step.output.offset - step.driving.base)
        garment = residual[:, self.avatar.garment_control_points()] * CENTIMETRES
        return self.config.loss.residual * garment.square().sum(-1).mean()

    def _compare_gradients(self, losses: Mapping[str, Tensor]) -> dict[str, float] | None:
        weight = self.avatar.network.encoder.pyramid.first.weight
        # A loss that is switched off, or of frames without a past, is a constant.
        names = [name for name, loss in losses.items() if loss.requires_grad]
        gradients = [
            torch.autograd.grad(losses[name], weight, retain_graph=True, materialize_grads=True)[0].norm()
            for name in names
        ]
        norms = dict(zip(names, torch.stack([self._zero(), *gradients]).tolist()[1:], strict=True))
        render = norms.pop("render", 0.0)
        return {name: norm / render for name, norm in norms.items()} if render else None

    def _temporal(self, step: _Step) -> dict[str, Tensor]:
        """Append this frame's record and return the temporal losses against the frames before it."""
        avatar, history = self.avatar, self.state.history
        posed = avatar.pose_control_points(step.driving.control_transforms, step.output)
        history.append(TemporalRecord(step.output, posed), step.driving.speed)
        return temporal_losses(
            history.records,
            history.magnitudes,
            [cursor.age for cursor in step.cursors],
            avatar.network.occupied,
            avatar.control.cells,
            self.config.loss,
        )

    def _backward(self, loss: Tensor, mse: Tensor | None, count: int) -> UpdateMetrics:
        loss = loss / count
        # Read together: the host waits for a GPU once.
        value, error = torch.stack([loss.detach(), mse if mse is not None else self._zero()]).tolist()
        if not math.isfinite(value):
            raise TrainingError(
                f"the loss is {value}; first tensor that is not finite: {self._first_not_finite()}"
            )
        loss.backward()
        return UpdateMetrics(value, error / count if mse is not None else None)

    def _zero(self) -> Tensor:
        return torch.zeros((), device=self.device)

    def _first_not_finite(self) -> str:
        state = {f"state.{name}": value for name, value in self.state.rollout_tensors().items()}
        named = [*self.avatar.named_parameters(), *state.items()]
        return next((name for name, value in named if not value.isfinite().all()), "the rendered image")
