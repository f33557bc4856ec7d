"""The avatar: template, network and skeleton; one step of it makes one frame of posed Gaussians."""

import dataclasses
from collections.abc import Collection, Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from dsar.avatar.bilinear import sample_bilinear
from dsar.avatar.charts import Atlas, Chart, ChartTexels, body_chart
from dsar.avatar.control_grid import ControlGrid
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.fused_posing import pose_fused
from dsar.avatar.garment_chart import fit_garment_chart, texels_beneath
from dsar.avatar.guard_limits import GuardLimits
from dsar.avatar.guards import LIMITS, Guard
from dsar.avatar.input_maps import InputMaps, make_input_maps
from dsar.avatar.input_statistics import InputStatistics
from dsar.avatar.motion_prior import MotionPrior
from dsar.avatar.posing import pose_gaussians
from dsar.avatar.principal_poses import PrincipalPoses
from dsar.avatar.rest_frames import find_rest_frames
from dsar.avatar.template import VISIBLE_LOGIT, GaussianParameters
from dsar.avatar.texel_skin import TexelSkin
from dsar.body.model import PARENTS
from dsar.body.skinning import blend_transforms
from dsar.config import AtlasConfig, ModelConfig
from dsar.devices import takes_kernels
from dsar.geometry.harmonics import dc_from_color
from dsar.network import STREAMS, NetworkOutput, NetworkState, Stream, build_network
from dsar.types import Body, Capture, Gaussians, Motion

BORDER = 0.05
"""Metres from a garment within which bare skin may carry its paint."""
STRAYED = 0.02
"""Metres from its texel from which on a Gaussian of bare skin is none any more."""
GARMENT_FRAMES = 12
"""Rest frames whose masks shape the garment's chart."""


class Avatar(nn.Module):
    """A person who can be driven by any SMPL-X motion.

    A motion drives it as a *driving signal*, one step as a *motion window*; see `dsar.avatar.driving`.
    """

    texels: Tensor
    texel_weights: Tensor
    texel_positions: Tensor
    texel_frames: Tensor
    texel_tangents: Tensor
    texel_hidden: Tensor
    texel_beneath: Tensor
    """Texels of the body that a garment covers at times: their looks do not change any more."""
    texel_borrowed: Tensor
    """Those of them that were never seen without one, and have the looks of others."""
    texel_axes: Tensor
    garment_indices: Tensor
    garment_point_indices: Tensor
    body_joints: Tensor

    def __init__(self, body: Body, atlas: Atlas, model: ModelConfig, fps: float) -> None:
        super().__init__()
        if len(atlas.charts) == 1:
            model = dataclasses.replace(model, prior="none")
        self.model, self.fps = model, fps
        for name in ("vertices", "faces", "joints", "weights", "uv", "uv_faces"):
            self.register_buffer(f"body_{name}", getattr(body, name))
        self.charts, self.atlas_size = atlas.charts, (atlas.height, atlas.width)
        self.register_buffer("texels", atlas.texels)
        self.register_buffer("texel_positions", atlas.positions)
        self.register_buffer("texel_weights", atlas.weights)
        self.register_buffer("texel_frames", atlas.frames)
        self.register_buffer("texel_tangents", atlas.tangents)
        self.register_buffer("texel_hidden", atlas.hidden)
        self.register_buffer("texel_beneath", atlas.hidden.clone())
        self.register_buffer("texel_borrowed", atlas.hidden.clone())
        axes = atlas.frames if model.axes == "surface" else torch.eye(3).expand_as(atlas.frames)
        self.register_buffer("texel_axes", axes.contiguous(), persistent=False)
        self.texel_skin = TexelSkin.of_weights(atlas.weights)
        self.control = ControlGrid(atlas, model.upsample, surface_axes=model.axes == "surface")
        # Kept, for finding them makes the host wait for a GPU.
        self.register_buffer("garment_indices", self.texels_on(self.garments), persistent=False)
        garment_points = self.control.on_charts(self.control.charts[1:])
        self.register_buffer("garment_point_indices", garment_points, persistent=False)
        self.prior: MotionPrior | None = None
        if model.prior == "cloth":
            self.prior = MotionPrior(atlas.charts[1:], self.control, model.upsample, atlas.width)
        self.statistics = InputStatistics(model.map_channels)
        self.principal_poses = PrincipalPoses(model.pose_components, len(self.control.cells), LIMITS.pose)
        self.template = GaussianParameters(atlas.positions, atlas.tangents, atlas.hidden, model.sh_degree)
        self.network = build_network(model, self.control.occupied)
        self.guard_limits: GuardLimits | None = None
        """Where guards of rollouts act; None: rollouts show what the network says, whatever it is."""

    @classmethod
    def from_capture(cls, capture: Capture, body: Body, atlas: AtlasConfig, model: ModelConfig) -> "Avatar":
        """Build an untrained avatar: atlas from body and silhouettes, input statistics from the motions."""
        signals = {
            name: DrivingSignal.of_motion(body, capture.motions[name], model.mean_time_constants)
            for name in capture.splits["train"]
        }
        avatar = cls(body, _fit_atlas(capture, body, atlas, signals), model, next(iter(signals.values())).fps)
        avatar.fit_input_statistics([avatar.with_cloth(signal) for signal in signals.values()])
        return avatar

    @property
    def device(self) -> torch.device:
        """Where the avatar is, and what it makes."""
        return self.texel_positions.device

    @property
    def body(self) -> Body:
        """The shaped body that drives the avatar."""
        names = ("vertices", "faces", "joints", "weights", "uv", "uv_faces")
        return Body(parents=PARENTS, **{name: getattr(self, f"body_{name}") for name in names})

    @property
    def atlas(self) -> Atlas:
        """The charts of texels that carry the Gaussians."""
        texels = (self.texel_positions, self.texel_weights, self.texel_frames, self.texel_tangents)
        return Atlas(self.charts, self.atlas_size[1], self.texels, *texels, self.texel_hidden)

    @property
    def garments(self) -> tuple[Chart, ...]:
        """The charts of loose garments, in texel rows; the body's comes before them."""
        return self.charts[1:]

    @property
    def num_gaussians(self) -> int:
        """Gaussians of every frame."""
        return len(self.texels)

    @property
    def borrowed_share(self) -> float | None:
        """Share of the fixed texels that never were seen without a garment; None without any."""
        fixed = int(self.texel_beneath.sum())
        return int(self.texel_borrowed.sum()) / fixed if fixed else None

    def texels_on(self, charts: Sequence[Chart]) -> Int64[Tensor, " g"]:
        """Return which Gaussians lie on some of the charts."""
        rows = self.texels // self.atlas_size[1]
        return torch.stack([chart.holds(rows) for chart in charts] or [rows < 0]).any(0).nonzero().squeeze(1)

    def garment_texels(self) -> Int64[Tensor, " g"]:
        """Return which Gaussians lie on garments' charts; none where there are none."""
        return self.garment_indices

    def garment_control_points(self) -> Int64[Tensor, " g"]:
        """Return which control points lie on garments' charts; none where there are none."""
        return self.garment_point_indices

    def driving_signal(self, motion: Motion) -> DrivingSignal:
        """Return what drives the avatar through a motion."""
        return self.with_cloth(DrivingSignal.of_motion(self.body, motion, self.model.mean_time_constants))

    def with_cloth(self, signal: DrivingSignal) -> DrivingSignal:
        """Return a driving signal with what the motion prior makes of it now, if there is one."""
        if self.prior is None:
            return signal
        shots = [self.prior.simulate(self.body, signal.steady[shot], signal.fps) for shot in signal.shots]
        return dataclasses.replace(signal, cloth=torch.cat(shots))

    @torch.no_grad()
    def place_prior(self) -> None:
        """Give the motion prior the garments' rest shapes; called once the template is fitted."""
        if self.prior is not None:
            for chart, garment in zip(self.garments, self.prior.garments, strict=True):
                texels = self.texels_on([chart])
                garment.place(self.template.means[texels], self.texel_weights[texels])

    def initial_state(self, batch: int = 1) -> NetworkState:
        """Return the state of rollouts that have seen nothing yet."""
        return self.network.initial_state(batch)

    def input_maps(
        self,
        motion_windows: Float[Tensor, "b t j 4 4"],
        fps: float,
        cloth: Float[Tensor, "b g 6"] | None = None,
    ) -> InputMaps:
        """Return the network's input maps, in metres; `cloth` is the motion prior of avatars that have one.

        Outside training, poses are brought into the range of the training poses, if the model says so.
        """
        inputs = make_input_maps(self.control, motion_windows, self.body_joints[0], fps, self.model, cloth)
        maps, limited = self.principal_poses(inputs.maps, self.control.cells)
        return InputMaps(maps, inputs.magnitude, {**inputs.guard_counts, Guard.POSE: limited})

    @torch.no_grad()
    def fit_input_statistics(self, signals: Sequence[DrivingSignal]) -> None:
        """Set the statistics that standardise input maps from every fourth frame of training motions."""
        maps, magnitudes = [], []
        for signal in signals:
            for frames in torch.arange(0, len(signal), 4).split(16):
                windows, cloth = signal.windows[frames], signal.cloth_at(frames.tolist())
                pelvis = self.body_joints[0]
                inputs = make_input_maps(self.control, windows, pelvis, self.fps, self.model, cloth)
                maps.append(inputs.maps.flatten(2)[:, :, self.control.cells])
                magnitudes.append(inputs.magnitude.flatten(2)[:, :, self.control.cells])
        values = torch.cat(maps)
        self.statistics.fit(values, torch.cat(magnitudes))
        self.principal_poses.fit(values[:, :3])

    def standardize(self, inputs: InputMaps) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Return input maps and motion magnitudes as the network takes them."""
        maps, magnitude = self.statistics.standardize(inputs)
        return maps * self.network.occupied, magnitude

    @torch.no_grad()
    def unhide_covered_texels(self) -> None:
        """Show the body beneath garments as the nearest bare texel is; called once the template is fitted.

        Fitted along with the garment it would be painted like it, and when the cloth lifts, that paint
        stays behind. From then on these texels are fixed: nothing but `fix_looks` changes their looks.
        """
        if not self.texel_hidden.any():
            return
        self._borrow_looks(self.texel_hidden, self._bare_texels(self.texel_hidden))
        self.texel_hidden.fill_(False)

    @torch.no_grad()
    def fix_looks(
        self, fixed: Bool[Tensor, " n"], colors: Float[Tensor, "n 3"], seen: Bool[Tensor, " n"]
    ) -> None:
        """Give body texels that a garment covers at times their looks, which nothing changes any more.

        Those that strayed from the body, to fill in for the garment's border, come back.

        Args:
            fixed: These texels, besides those that are fixed already.
            colors: Display-referred sRGB in [0, 1] of those that were `seen` in pixels without a garment. The
                others take the looks of the nearest texel that was, or that no garment ever covers.
            seen: Which fixed texels have a colour.
        """
        self.texel_beneath |= fixed
        seen = seen & self.texel_beneath
        harmonics = self.template.harmonics
        harmonics[seen] = 0.0
        harmonics[seen, 0] = dc_from_color(colors[seen])
        sources = torch.cat([seen.nonzero().squeeze(1), self._bare_texels(self.texel_beneath)])
        self._borrow_looks(self.texel_beneath & ~seen, sources)
        strayed = (self.template.means - self.texel_positions).norm(dim=1) > STRAYED
        self.template.reset_shapes(self.texel_beneath & strayed, self.texel_positions, self.texel_tangents)
        logits = self.template.opacity_logits
        logits[self.texel_beneath] = logits[self.texel_beneath].clamp_min(VISIBLE_LOGIT)
        self.texel_borrowed.copy_(self.texel_beneath & ~seen)

    def _bare_texels(self, beneath: Bool[Tensor, " n"]) -> Int64[Tensor, " m"]:
        """Return the body's texels that are not beneath a garment, far enough from those to be unpainted."""
        body, points = self.texels_on(self.charts[:1]), self.texel_positions
        bare = body[~beneath[body]]
        if not beneath.any():
            return bare
        apart = torch.cdist(points[bare], points[beneath]).amin(1) > BORDER
        return bare[apart] if apart.any() else bare

    def _borrow_looks(self, which: Bool[Tensor, " n"], sources: Int64[Tensor, " m"]) -> None:
        """Give some texels the colours of the nearest of others, and let them be seen."""
        points = self.texel_positions
        nearest = sources[torch.cdist(points[which], points[sources]).argmin(1)]
        self.template.harmonics[which] = self.template.harmonics[nearest]
        self.template.opacity_logits[which] = VISIBLE_LOGIT

    def gather_control_points(self, offset: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b p 3"]:
        """Return a map's offsets at the control points, along their own axes, metres."""
        return self.control.gather(offset)

    def scatter_garment_points(self, offsets: Float[Tensor, "b g 3"]) -> Float[Tensor, "b p 3"]:
        """Return the garments' offsets among those of all control points, which stay where they are."""
        still = offsets.new_zeros(len(offsets), len(self.control.cells), 3)
        return still.index_copy(1, self.garment_control_points(), offsets)

    def offset_garment(self, offsets: Float[Tensor, "b g 3"]) -> NetworkOutput:
        """Return an output that moves the garments' control points by these offsets, and nothing else."""
        offset = self.control.scatter(self.scatter_garment_points(offsets))
        appearance = offset.new_zeros(len(offset), self.model.appearance_channels, *self.control.size)
        return NetworkOutput(offset, appearance, ())

    def forward_frame(
        self,
        motion_windows: Float[Tensor, "b t j 4 4"],
        state: NetworkState,
        cloth: Float[Tensor, "b g 6"] | None = None,
        *,
        streams: Collection[Stream] = STREAMS,
    ) -> tuple[NetworkOutput, NetworkState, InputMaps]:
        """Run the network one frame on; return the output, the next state and the maps it saw."""
        inputs = self.input_maps(motion_windows, self.fps, cloth)
        output, state = self.network(*self.standardize(inputs), state, streams=streams)
        return self.add_prior(output, cloth), state, inputs

    def add_prior(self, output: NetworkOutput, cloth: Float[Tensor, "b g 6"] | None) -> NetworkOutput:
        """Return the network's output on top of the motion prior, which is the base of the offset."""
        if cloth is None:
            return output
        return dataclasses.replace(output, offset=output.offset + self.offset_base(cloth))

    def offset_base(self, cloth: Float[Tensor, "b g 6"]) -> Float[Tensor, "b 3 h w"]:
        """Return the offset maps, metres, that the network's are added to; the avatar has a motion prior."""
        if self.prior is None:
            raise ValueError("the avatar has no motion prior")
        return self.control.scatter(self.scatter_garment_points(self.prior.base(cloth)))

    def gaussians(
        self, motion_windows: Float[Tensor, "b t j 4 4"], output: NetworkOutput | None
    ) -> list[Gaussians]:
        """Return the posed Gaussians of each batch entry; without an output, the template's."""
        transforms = motion_windows[:, 0]
        if output is None:
            shape = (len(motion_windows), 3 + self.model.appearance_channels, *self.control.size)
            offset, appearance = transforms.new_zeros(shape).split([3, shape[1] - 3], 1)
        else:
            offset, appearance = output.offset, output.appearance
        sampling = self.control.sampling
        if transforms.dtype == torch.float32 and takes_kernels(transforms):
            bones = self.texel_skin.blend(transforms)
            axes, fixed = self.texel_axes, self.texel_beneath
            return pose_fused(self.template, offset, appearance, sampling, axes, *bones, fixed)
        blended = blend_transforms(self.texel_weights, transforms)
        offsets = (self.texel_axes * sample_bilinear(offset, sampling)[..., None, :]).sum(-1)
        residuals = sample_bilinear(appearance, sampling)
        return pose_gaussians(self.template.activate(offsets, residuals, self.texel_beneath), blended)

    def deformed_control_points(
        self, motion_windows: Float[Tensor, "b t j 4 4"], output: NetworkOutput
    ) -> Float[Tensor, "b p 3"]:
        """Return the newest frame's control points, offset and posed, world metres."""
        blended = blend_transforms(self.control.weights, motion_windows[:, :1])[:, 0]
        return self.pose_control_points(blended, output)

    def pose_control_points(
        self, blended: Float[Tensor, "b p 3 4"], output: NetworkOutput
    ) -> Float[Tensor, "b p 3"]:
        """Return the control points, offset and posed by each one's blend of transforms, world metres."""
        offsets = self.gather_control_points(output.offset)
        points = self.control.points + (self.control.axes * offsets[..., None, :]).sum(-1)
        return (blended[..., :3] * points[..., None, :]).sum(-1) + blended[..., 3]


def _fit_atlas(capture: Capture, body: Body, config: AtlasConfig, signals: dict[str, DrivingSignal]) -> Atlas:
    """Return the body's chart and, where rest frames show a loose garment, its own."""
    charts: list[ChartTexels] = [body_chart(body, config.resolution)]
    if config.garment != "auto":
        return Atlas.stack(charts)
    transforms = {name: signal.transforms for name, signal in signals.items()}
    fps = next(iter(signals.values())).fps
    frames = find_rest_frames(transforms, fps, GARMENT_FRAMES, 3, capture.cameras_with_image)
    pelvis = torch.stack([transforms[name][frame, 0] for name, frame in frames])
    size = (config.garment_rows, config.resolution)
    garment = fit_garment_chart(body, capture, frames, pelvis, size, config.weight_smoothing)
    if garment is None:
        return Atlas.stack(charts)
    return Atlas.stack([*charts, garment], texels_beneath(body, garment, charts[0]))
