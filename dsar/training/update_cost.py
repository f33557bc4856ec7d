"""What one update costs: it is gone through on torch's `meta` device, which has sizes and no values.

Network, posing and losses are those of training, in plain torch, as on a GPU; on a CPU the compiled kernels
take less. The rasteriser alone is stood in for: its backends need values. What it would list is an estimate.
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from dsar.avatar.bilinear import BilinearSampling, sample_bilinear
from dsar.avatar.posing import pose_gaussians
from dsar.avatar.template import SCALE_IN_TEXELS, GaussianParameters
from dsar.body.skinning import blend_transforms
from dsar.config import ScheduleConfig, TrainConfig
from dsar.metrics.lpips import Lpips
from dsar.network import NetworkOutput, NetworkState, build_network
from dsar.training.driving_maps import CAPACITY
from dsar.training.image_losses import image_losses
from dsar.training.operation_meter import Operation, OperationMeter
from dsar.training.targets import Target
from dsar.training.temporal_losses import TemporalHistory, TemporalRecord, temporal_losses
from dsar.types import Camera, Gaussians, RenderOutput

PARAMETERS = "parameters, gradients, moments"
BUFFERS = "tables"
NETWORK = "network"
POSING = "posed Gaussians"
RASTERIZER = "rasteriser"
IMAGES = "images and their losses"
TEMPORAL = "temporal losses"
BACKWARD = "on the way back"
_RECORD_SIZE = 10
"""Floats that a rasteriser keeps of a splat."""
_PAIR_MARGIN = 2.0
"""Gaussians grow while they learn, and with them the tiles that they touch."""
_CUTOFF = 3.3
"""Standard deviations at which an opaque splat ends."""
_DILATION = 0.3
_TILE = 16
_JOINTS = 55
"""Of SMPL-X."""
_PAST_FRAMES = 2
"""That the temporal losses look back."""
_META = torch.device("meta")


@dataclass(frozen=True)
class UpdateCost:
    """What one worker needs for one update of the autoregressive stage."""

    parameters: int
    """Of the network."""
    memory: dict[str, int]
    """Bytes by part when most live."""
    operations: tuple[Operation, ...]
    """Forward and backward, without the rasteriser and the optimiser."""

    @property
    def total_memory(self) -> int:
        """Bytes of all parts."""
        return sum(self.memory.values())

    @property
    def network_flop(self) -> int:
        """Floating-point operations of the network: forward, and twice as many on the way back."""
        return 3 * sum(o.flop for o in self.operations if o.part == NETWORK)


def map_size(config: TrainConfig) -> tuple[int, int]:
    """Return height and width of the network's maps; with a garment chart, if one may come."""
    rows, columns = atlas_size(config)
    return rows // config.model.upsample, columns // config.model.upsample


def atlas_size(config: TrainConfig) -> tuple[int, int]:
    """Return rows and columns of texels, every one of which may carry a Gaussian; likewise."""
    atlas = config.atlas
    return atlas.resolution + atlas.garment_rows * (atlas.garment == "auto"), atlas.resolution


_SCHEDULE = (
    *("rollouts_per_worker", "rendered_fraction", "views", "chunk_frames"),
    *("muon_rate", "recomputation"),
)
"""Settings of the schedule that an update's cost depends on."""
MOST_IMITATED = 64
"""Rollouts of the largest batch that is imitated, view by view."""


class _ImitatedUpdate:
    """An update on the meta device, part by part."""

    def __init__(self, config: TrainConfig, view: tuple[int, int]) -> None:
        self.config, self.view, self.meter = config, view, OperationMeter(_META.type)
        schedule, size = config.schedule, map_size(config)
        self.rollouts, points = schedule.rollouts_per_worker, size[0] * size[1]
        self.rendered = max(1, math.ceil(schedule.rendered_fraction * self.rollouts))
        rows, columns = atlas_size(config)
        texels = rows * columns
        # Made in main memory: to draw weights on the meta device torch loads its compiler, for seconds.
        self.network = build_network(config.model, torch.ones(size, dtype=torch.bool)).to(_META)
        with _META:
            self.network.recomputes = schedule.recomputation == "on"
            tangents, hidden = torch.empty(texels, 3, 2), torch.zeros(texels, dtype=torch.bool)
            self.template = GaussianParameters(
                torch.empty(texels, 3), tangents, hidden, config.model.sh_degree
            )
            self.lpips = Lpips("alex") if config.loss.lpips else None
            self.maps = torch.empty(self.rollouts, config.model.map_channels, *size)
            self.magnitude = torch.empty(self.rollouts, 1, *size)
            self.skin, self.axes = torch.empty(texels, _JOINTS), torch.empty(texels, 3, 3)
            self.sampling = BilinearSampling(
                torch.empty(texels, 4, dtype=torch.int32), torch.empty(texels, 4)
            )
            self.cells = torch.empty(points, dtype=torch.int64)
            self.transforms = torch.empty(self.rollouts, _JOINTS, 4, 4)
            self.control_transforms = torch.empty(self.rollouts, points, 3, 4)
            # Of the control points: skin weights, and these times homogeneous positions.
            basis = torch.empty(points, 5 * _JOINTS)
            table = torch.empty(CAPACITY, dtype=torch.uint8)
            moments = self._moments()
        fixed = [self.skin, self.axes, *self.sampling, self.cells, basis, table]
        self.meter.follow(BUFFERS, fixed + ([*self.lpips.parameters()] if self.lpips is not None else []))
        self.meter.follow(PARAMETERS, [*self.network.parameters(), *self.template.parameters(), *moments])
        self._keep = moments, basis, table

    def _moments(self) -> list[Tensor]:
        """Return tensors as large as the gradients and the optimisers' moments."""
        parameters = [*self.network.parameters(), *self.template.parameters()]
        hidden = {id(p) for p in self.network.hidden_weights()} if self.config.schedule.muon_rate else set()
        for parameter in parameters:
            parameter.grad = torch.empty_like(parameter)
        gradients = [p.grad for p in parameters if p.grad is not None]
        first = [torch.empty_like(p) for p in parameters]
        return gradients + first + [torch.empty_like(p) for p in parameters if id(p) not in hidden]

    def run(self) -> UpdateCost:
        """Go through a chunk and back."""
        meter, schedule, loss = self.meter, self.config.schedule, torch.zeros((), device=_META)
        state, history = self._begin()
        gaussians: list[Gaussians] = []
        with meter:
            for _ in range(schedule.chunk_frames):
                with meter.part(NETWORK):
                    output, state = self.network(self.maps, self.magnitude, state)
                with meter.part(POSING):
                    gaussians += self._pose(output)
                with meter.part(TEMPORAL):
                    loss = loss + self._compare_frames(output, history)
            loss = loss + self._compare_views(gaussians)
            with meter.part(BACKWARD):
                # Now and then the losses' gradients are compared, which needs the graph more than once.
                loss.backward(retain_graph=True)
        parameters = sum(p.numel() for p in self.network.parameters())
        return UpdateCost(parameters, dict(meter.peak), tuple(meter.operations))

    def _begin(self) -> tuple[NetworkState, TemporalHistory]:
        """Return what a chunk takes over from those before it."""
        rollouts, history = self.rollouts, TemporalHistory(self.config.model.window)
        with torch.no_grad(), _META:
            state = self.network.initial_state(rollouts)
            # The network looks at it, so it needs values.
            state = dataclasses.replace(state, fresh=torch.zeros(rollouts, dtype=torch.bool))
            for _ in range(_PAST_FRAMES):
                output, state = self.network(self.maps, self.magnitude, state)
                posed = torch.empty(rollouts, len(self.cells), 3)
                history.append(TemporalRecord(output, posed), self.magnitude)
                past = [output.offset, output.appearance, *output.features, posed]
                self.meter.follow(TEMPORAL, past)
        tensors: list[Tensor] = []
        state.map(lambda tensor: (tensors.append(tensor), tensor)[1])
        self.meter.follow(NETWORK, tensors)
        return state, history

    def _pose(self, output: NetworkOutput) -> list[Gaussians]:
        """Return the Gaussians of the rendered rollouts, as `Avatar.gaussians` makes them on a GPU."""
        output = output.select(torch.empty(self.rendered, dtype=torch.int64, device=_META))
        offsets = (self.axes * sample_bilinear(output.offset, self.sampling)[..., None, :]).sum(-1)
        residuals = sample_bilinear(output.appearance, self.sampling)
        canonical = self.template.activate(offsets, residuals, self.template.opacity_logits < 0)
        return pose_gaussians(canonical, blend_transforms(self.skin, self.transforms[: self.rendered]))

    def _compare_frames(self, output: NetworkOutput, history: TemporalHistory) -> Tensor:
        """Return the losses between a frame and those before it."""
        points = output.offset.flatten(2)[:, :, self.cells].transpose(1, 2)
        posed = (self.control_transforms[..., :3] * points[..., None, :]).sum(-1)
        history.append(TemporalRecord(output, posed), self.magnitude)
        ages = [_PAST_FRAMES] * self.rollouts
        occupied = self.network.occupied
        losses = temporal_losses(
            history.records, history.magnitudes, ages, occupied, self.cells, self.config.loss
        )
        return torch.stack(list(losses.values())).sum()

    def _compare_views(self, gaussians: list[Gaussians]) -> Tensor:
        """Return the summed losses of the views of some frames."""
        (height, width), config = self.view, self.config
        camera, targets = Camera(torch.eye(3), torch.eye(4), width, height, "view"), []
        with self.meter.part(RASTERIZER):
            images = self._draw(gaussians)
        with self.meter.part(IMAGES), _META:
            for _ in images:
                targets.append(Target(torch.empty(height, width, 3), torch.empty(height, width), camera))
            backgrounds = torch.empty(len(images), 3)
            return image_losses(images, targets, backgrounds, config.loss, self.lpips)[0].sum()

    def _draw(self, gaussians: list[Gaussians]) -> list[RenderOutput]:
        """Return the views of all frames, drawn in one call."""
        names = [field.name for field in dataclasses.fields(Gaussians)]
        fields = [torch.cat([getattr(frame, name) for frame in gaussians]) for name in names]
        count = len(gaussians) * self.config.schedule.views
        drawn = _ImitatedDrawing.apply(self.view, len(gaussians), count, *fields)  # pyright: ignore
        culled = torch.empty((), dtype=torch.int64, device=_META)
        colors, alphas, depths = (image.unbind() for image in drawn)
        parts = zip(colors, alphas, depths, strict=True)
        return [RenderOutput(color, alpha, depth, culled) for color, alpha, depth in parts]


class _ImitatedDrawing(torch.autograd.Function):
    """Takes what the Warp backend takes of views of as many sets of Gaussians, and as long."""

    @staticmethod
    def forward(
        ctx: Any, view: tuple[int, int], sets: int, views: int, *fields: Tensor
    ) -> tuple[Tensor, ...]:
        gaussians, empty = len(fields[0]) // sets, fields[0].new_empty
        count, pairs = gaussians * views, estimate_pairs(gaussians, view) * views
        records, drawable = empty(count, _RECORD_SIZE), empty(count, dtype=torch.int32)
        ends, keys = empty(count, dtype=torch.int64), empty(pairs, dtype=torch.int64)
        places, owners = torch.empty_like(keys), empty(pairs, dtype=torch.int32)
        # A sort has its result beside its input.
        _, listed = torch.empty_like(keys), torch.empty_like(owners)
        color, alpha, depth, passed = (empty(views, *view, *more) for more in ((3,), (), (), ()))
        ctx.save_for_backward(*fields, depth, passed, empty(views, *view, dtype=torch.int32))
        ctx.splats = records, drawable, ends, places, listed
        return color, alpha, depth

    @staticmethod
    def backward(ctx: Any, *v_images: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        fields, (records, *_, listed) = ctx.saved_tensors[:5], ctx.splats
        _ = records.new_empty(len(listed), _RECORD_SIZE), torch.empty_like(records)
        return None, None, None, *(torch.empty_like(field) for field in fields)


def estimate_pairs(gaussians: int, view: tuple[int, int]) -> int:
    """Return how many pairs of a splat and a tile a view has: an upper estimate.

    As if the surface filled the image, front and back, by Gaussians as large as their texels, and as many
    tiles again.
    """
    spacing = math.sqrt(2 * view[0] * view[1] / gaussians)
    radius = _CUTOFF * math.hypot(SCALE_IN_TEXELS * spacing, math.sqrt(_DILATION))
    return int(_PAIR_MARGIN * gaussians * (1 + 2 * radius / _TILE) ** 2)


def cost_of_update(config: TrainConfig, view: tuple[int, int]) -> UpdateCost:
    """Return what an update of these settings costs one worker, on views of a height and width in pixels.

    Of many rollouts two smaller batches are imitated: memory grows by as much with each rollout.
    """
    schedule = {name: getattr(config.schedule, name) for name in _SCHEDULE}
    what_counts = TrainConfig(
        atlas=config.atlas, model=config.model, loss=config.loss, schedule=ScheduleConfig(**schedule)
    )
    rollouts = config.schedule.rollouts_per_worker
    if rollouts <= MOST_IMITATED:
        return _imitated(what_counts, view)
    half, whole = (
        _imitated(_with_rollouts(what_counts, count), view) for count in (MOST_IMITATED // 2, MOST_IMITATED)
    )
    more, times = rollouts / MOST_IMITATED - 1, rollouts / MOST_IMITATED
    memory = {
        part: size + round(2 * more * (size - half.memory.get(part, 0)))
        for part, size in whole.memory.items()
    }
    operations = (
        dataclasses.replace(o, flop=round(times * o.flop), traffic=round(times * o.traffic))
        for o in whole.operations
    )
    return UpdateCost(whole.parameters, memory, tuple(operations))


def _with_rollouts(config: TrainConfig, count: int) -> TrainConfig:
    schedule = dataclasses.replace(config.schedule, rollouts_per_worker=count)
    return dataclasses.replace(config, schedule=schedule)


@lru_cache(maxsize=64)
def _imitated(config: TrainConfig, view: tuple[int, int]) -> UpdateCost:
    return _ImitatedUpdate(config, view).run()
