"""One update's worth of work: a chunk of K frames of several rollouts, rendered and compared."""

import dataclasses
import math
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
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
from dsar.training.draws import Draws
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


@dataclass(frozen=True)
class _Frame:
    """Which frame of every rollout comes next."""

    cursors: list[RolloutCursor]
    """Where each rollout stands."""
    fresh: list[bool]
    """Which rollouts start afresh."""
    rendered: list[int]
    """Numbers of those that are compared with images."""


@dataclass(frozen=True)
class _Step:
    """One frame of every rollout, as the network has it."""

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

    def backward_template(self, draws: Draws, reduction: int) -> UpdateMetrics:
        """Back-propagate views of the template in the shapes it has in still frames."""
        rest, views = self.state.rest, self._view_batch(reduction)
        generators = draws.generators(self.config.schedule.template_frames_per_worker)
        chosen = [int(rng.integers(len(rest.frames))) for rng in generators]
        frames = [rest.frames[index] for index in chosen]
        for rng, (name, frame) in zip(generators, frames, strict=True):
            views.request(rng, name, frame)
        count = workers.begin_mean(float(len(views)))
        windows = torch.stack([self.signals[name].windows[frame, :1] for name, frame in frames])
        outputs = rest.output(self.avatar, send(torch.tensor(chosen), self.device))
        rendered, mse = self._compare(views, self.avatar.gaussians(windows, outputs), count)
        return self._backward(rendered + rest.loss(self.avatar, self.config.loss), mse)

    def backward_pretraining(self, draws: Draws) -> UpdateMetrics:
        """Step every rollout by K frames and back-propagate the distance to the registered maps."""
        self._show_whole_body()
        loss, frames = self._zero(), self.config.schedule.chunk_frames
        generators = draws.generators(len(self.state.rollouts.cursors))
        for _ in range(frames):
            frame = self._next_frame(generators, WHOLE_CLIP, rendered_fraction=0.0)
            step = self._step(frame, streams=STREAMS)
            loss = loss + (self._registered_distance(step) + self._residual(step)) / frames
        self._detach_state()
        return self._backward(loss, None)

    def backward_chunk(
        self, draws: Draws, schedule_state: ScheduleState, *, probe: bool = False
    ) -> UpdateMetrics:
        """Step every rollout by K frames and back-propagate L_total (paper equation 22).

        The whole body is shown. L_total has losses over space and to registered maps besides. Images count by
        the view, all else by the frame. With `probe`, report how the gradients of the losses compare.
        """
        self._show_whole_body()
        schedule = self.config.schedule
        streams = STREAMS if schedule_state.stage == "autoregressive" else ()
        losses: dict[str, Tensor] = defaultdict(self._zero)
        views, gaussians = self._view_batch(schedule_state.reduction), list[Gaussians]()
        generators = draws.generators(len(self.state.rollouts.cursors))
        longest, fraction = schedule_state.max_rollout_frames, schedule.rendered_fraction
        frames = [self._next_frame(generators, longest, fraction) for _ in range(schedule.chunk_frames)]
        for frame in frames:
            for i in frame.rendered:
                views.request(generators[i], frame.cursors[i].sequence, frame.cursors[i].frame)
        count = workers.begin_mean(float(len(views)))
        for frame in frames:
            step = self._step(frame, streams=streams)
            gaussians += self._pose(step, frame.rendered) if frame.rendered else []
            for name, loss in self._regularizers(step, streams).items():
                losses[name] = losses[name] + loss / schedule.chunk_frames
        self._detach_state()
        losses["render"], mse = self._compare(views, gaussians, count)
        gradients = self._compare_gradients(losses) if probe else None
        metrics = self._backward(torch.stack(list(losses.values())).sum(), mse)
        return dataclasses.replace(metrics, gradients=gradients)

    def _show_whole_body(self) -> None:
        # Asked once, for the answer makes the host wait for a GPU.
        if not self._shown:
            self.avatar.unhide_covered_texels()
            self._shown = True

    def _next_frame(
        self, generators: Sequence[np.random.Generator], longest: int, rendered_fraction: float
    ) -> _Frame:
        """Move every rollout one frame on, some of them to a fresh start."""
        cursors, fresh = self.state.rollouts.next_frames(generators, longest)
        cursors = [dataclasses.replace(cursor) for cursor in cursors]
        self.state.rollouts.advance()
        rendered = [i for i, rng in enumerate(generators) if rng.random() < rendered_fraction]
        return _Frame(cursors, fresh, rendered)

    def _step(self, frame: _Frame, *, streams: Collection[Stream]) -> _Step:
        """Step the network of every rollout by a frame."""
        state, cursors = self.state, frame.cursors
        state.network = state.network.restart(send(torch.tensor(frame.fresh), self.device))
        driving = self.driving.gather(cursors)
        output, state.network = self.avatar.network(
            driving.maps, driving.magnitude, state.network, streams=streams
        )
        output = dataclasses.replace(output, offset=output.offset + driving.base)
        mirrored = send(torch.tensor([cursor.mirrored for cursor in cursors]), self.device)
        unmirrored = self.mirror.unmirror(output, mirrored) if self.mirror is not None else output
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

    def _view_batch(self, reduction: int) -> ViewBatch:
        return ViewBatch(self.loader, reduction, self.config.schedule.views)

    def _compare(
        self, views: ViewBatch, gaussians: list[Gaussians], count: Callable[[], float]
    ) -> tuple[Tensor, Tensor]:
        """Return loss and squared error of views, divided by how many a worker has in the mean.

        So their mean over workers is the mean over all views, of which one may have more than another.
        """
        loss, mse = views.compare(gaussians, self.config.loss, self.lpips)
        mean_count = count() or 1.0
        return loss / mean_count, mse / mean_count

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

    def _backward(self, loss: Tensor, mse: Tensor | None) -> UpdateMetrics:
        # Read together: the host waits for a GPU once.
        value, error = torch.stack([loss.detach(), mse if mse is not None else self._zero()]).tolist()
        if not math.isfinite(value):
            raise TrainingError(
                f"the loss is {value}; first tensor that is not finite: {self._first_not_finite()}"
            )
        loss.backward()
        return UpdateMetrics(value, error if mse is not None else None)

    def _zero(self) -> Tensor:
        return torch.zeros((), device=self.device)

    def _first_not_finite(self) -> str:
        state = {f"state.{name}": value for name, value in self.state.rollout_tensors().items()}
        named = [*self.avatar.named_parameters(), *state.items()]
        return next((name for name, value in named if not value.isfinite().all()), "the rendered image")
