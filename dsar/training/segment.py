"""One update's worth of work: a segment of K frames of several rollouts, rendered and compared."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from dsar.avatar.avatar import Avatar, contexts
from dsar.avatar.mirror import mirror_track
from dsar.config import TrainConfig
from dsar.errors import TrainingError
from dsar.network import NetworkOutput, NetworkState
from dsar.network.maps import FrameMaps
from dsar.raster import rasterize, reduced_dilation
from dsar.training.losses import TemporalRecord, image_loss, registered_loss, spatial_loss, temporal_loss
from dsar.training.stages import Position
from dsar.training.streams import Stream, Streams
from dsar.training.targets import load_target
from dsar.types import Capture, Gaussians

TEMPLATE_FRAMES = 8
"""Frames of an update of the template alone."""


@dataclass(frozen=True)
class Progress:
    """What a segment reports."""

    loss: float
    """Total loss per rendered view."""
    mse: float | None
    """Mean squared colour error per view, over the crop and a random background; None without images."""


class SegmentTrainer:
    """Holds a worker's rollouts and turns each segment of them into gradients."""

    def __init__(
        self,
        config: TrainConfig,
        capture: Capture,
        avatar: Avatar,
        clips: dict[str, range],
        lpips: nn.Module | None,
    ) -> None:
        self.config, self.capture, self.avatar, self.lpips = config, capture, avatar, lpips
        self.tracks = {name: avatar.track(capture.motions[name]) for name in clips}
        self.mirror_tracks = {name: mirror_track(track) for name, track in self.tracks.items()}
        self.streams = Streams(clips, config.schedule.streams, config.schedule.mirrored)
        self.state: NetworkState = avatar.start(config.schedule.streams)
        self.registered: Mapping[str, tuple[range, Tensor]] = {}
        """Frames that have a registered map, and the maps, by sequence."""
        self.records: deque[TemporalRecord] = deque(maxlen=max(3, config.model.window))

    def template_segment(
        self, rng: np.random.Generator, still: list[tuple[str, int]], reduction: int
    ) -> Progress:
        """Back-propagate views of the template alone on still frames."""
        loss, mse = torch.zeros(()), torch.zeros(())
        for index in rng.choice(len(still), TEMPLATE_FRAMES):
            name, frame = still[index]
            context = contexts(self.tracks[name], torch.tensor([frame]))
            gaussians = self.avatar.gaussians(context, None)[0]
            view = self._views(rng, gaussians, name, frame, reduction)
            loss, mse = loss + view[0], mse + view[1]
        return self._finish(loss, mse, TEMPLATE_FRAMES * self.config.schedule.views)

    def segment(self, rng: np.random.Generator, position: Position) -> Progress:
        """Advance every rollout by K frames and back-propagate through them, the whole body shown."""
        self.avatar.reveal()
        schedule, with_streams = self.config.schedule, position.stage == "autoregressive"
        loss, mse, count = torch.zeros(()), torch.zeros(()), 0
        for _ in range(schedule.segment):
            places, fresh = self.streams.next_frames(rng, position.horizon)
            self.state = self.state.restart(torch.tensor(fresh))
            mirrored = torch.tensor([p.mirrored for p in places])
            context = self._contexts(places, self.tracks)
            seen = torch.where(
                mirrored[:, None, None, None, None], self._contexts(places, self.mirror_tracks), context
            )
            output, self.state, observed = self.avatar.advance(seen, self.state, streams=with_streams)
            shown = [i for i in range(len(places)) if rng.random() < schedule.rendered]
            answers = self.avatar.unmirror(output.select(shown), mirrored[shown])
            gaussians = self.avatar.gaussians(context[shown], answers) if shown else []
            for place, each in zip((places[i] for i in shown), gaussians, strict=True):
                view = self._views(rng, each, place.sequence, place.frame, position.reduction)
                loss, mse, count = loss + view[0], mse + view[1], count + schedule.views
            regularisers = self._spatial(output)
            if self.registered:
                regularisers = regularisers + self._registered(self.avatar.unmirror(output, mirrored), places)
            if with_streams:
                regularisers = regularisers + self._temporal(seen, output, observed, places)
            loss = loss + regularisers * len(shown) * schedule.views
            self.streams.advance()
        progress = self._finish(loss, mse, max(count, 1))
        self.state = self.state.detach()
        for _ in range(len(self.records)):
            self.records.append(self.records.popleft().detach())
        return progress

    def _contexts(self, places: list[Stream], tracks: dict[str, Tensor]) -> Tensor:
        return torch.cat([contexts(tracks[p.sequence], torch.tensor([p.frame])) for p in places])

    def carried(self) -> tuple[dict[str, Tensor], list[dict[str, str | int]]]:
        """Return what must survive a restart: the rollouts' state as tensors, and their places."""
        tensors = {"fresh": self.state.fresh, "motion": self.state.motion}
        tensors |= {"offset": self.state.offset, "memory": self.state.memory}
        tensors |= {f"window.{i}": level for i, level in enumerate(self.state.window)}
        for i, record in enumerate(self.records):
            tensors |= {f"record.{i}.offset": record.output.offset, f"record.{i}.posed": record.posed}
            tensors |= {f"record.{i}.appearance": record.output.appearance, f"record.{i}.speed": record.speed}
            tensors |= {f"record.{i}.feature.{k}": f for k, f in enumerate(record.output.features)}
        places = [vars(stream) for stream in self.streams.streams if stream is not None]
        return tensors, places

    def carry_on(self, tensors: dict[str, Tensor], places: list[dict[str, str | int]]) -> None:
        """Restore what `carried` returned."""
        levels = len(self.state.window)
        self.state = NetworkState(
            fresh=tensors["fresh"],
            window=tuple(tensors[f"window.{i}"] for i in range(levels)),
            motion=tensors["motion"],
            offset=tensors["offset"],
            memory=tensors["memory"],
        )
        self.records.clear()
        while f"record.{len(self.records)}.offset" in tensors:
            prefix = f"record.{len(self.records)}"
            features = tuple(tensors[f"{prefix}.feature.{k}"] for k in range(len(self.config.model.channels)))
            output = NetworkOutput(tensors[f"{prefix}.offset"], tensors[f"{prefix}.appearance"], features)
            self.records.append(
                TemporalRecord(output, tensors[f"{prefix}.posed"], tensors[f"{prefix}.speed"])
            )
        if places:
            self.streams.streams[:] = [Stream(**place) for place in places]  # pyright: ignore[reportArgumentType]

    def _views(
        self, rng: np.random.Generator, gaussians: Gaussians, sequence: str, frame: int, reduction: int
    ) -> tuple[Tensor, Tensor]:
        """Return summed loss and squared error of random cameras on a random background."""
        loss, mse = torch.zeros(()), torch.zeros(())
        for index in rng.choice(len(self.capture.cameras), self.config.schedule.views, replace=False):
            target = load_target(self.capture, sequence, frame, int(index), reduction)
            background = torch.from_numpy(rng.random(3, np.float32))
            output = rasterize(
                gaussians, target.camera, background=background, dilation=reduced_dilation(reduction)
            )
            one, error = image_loss(output, target, background, self.config.loss, self.lpips)
            loss, mse = loss + one, mse + error
        return loss, mse

    def _spatial(self, output: NetworkOutput) -> Tensor:
        return self.config.loss.spatial * spatial_loss(output.offset, self.avatar.cells, self.avatar.links)

    def _registered(self, output: NetworkOutput, places: list[Stream]) -> Tensor:
        """Return the loss against registered maps, of the frames that have one."""
        having = [
            i
            for i, place in enumerate(places)
            if place.sequence in self.registered and place.frame in self.registered[place.sequence][0]
        ]
        if not having:
            return torch.zeros(())
        maps = torch.stack([self.registered[places[i].sequence][1][places[i].frame] for i in having])
        distances = registered_loss(output.offset[having], maps, self.avatar.cells)
        return self.config.loss.registered * distances.sum() / len(places)

    def _temporal(
        self, context: Tensor, output: NetworkOutput, observed: FrameMaps, places: list[Stream]
    ) -> Tensor:
        """Append this frame's record and return the temporal losses against the frames before it."""
        avatar = self.avatar
        posed = avatar.deformed_control_points(context, output)
        self.records.append(TemporalRecord(output, posed, observed.speed))
        ages = [place.age for place in places]
        return temporal_loss(
            list(self.records), ages, avatar.network.occupied, avatar.cells, self.config.loss
        )

    def _finish(self, loss: Tensor, mse: Tensor, count: int) -> Progress:
        loss = loss / count
        if not loss.isfinite():
            raise TrainingError(
                f"the loss is {float(loss.detach())}; first tensor that is not finite: {self._culprit()}"
            )
        loss.backward()
        return Progress(float(loss.detach()), float(mse) / count)

    def _culprit(self) -> str:
        named = [*self.avatar.named_parameters(), *((f"state.{k}", v) for k, v in self.carried()[0].items())]
        return next((name for name, value in named if not value.isfinite().all()), "the rendered image")
