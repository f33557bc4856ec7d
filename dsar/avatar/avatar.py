"""The avatar: template, network and skeleton; one step of it makes one frame of posed Gaussians."""

import logging
from collections.abc import Collection

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from dsar.avatar.driving import driving_signal, find_jumps
from dsar.avatar.fused_posing import bilinear_sampling, pose_fused, sample_bilinear
from dsar.avatar.garment_chart import fit_garment_chart, texels_beneath
from dsar.avatar.input_maps import InputMaps, make_input_maps
from dsar.avatar.posing import pose_gaussians
from dsar.avatar.rest_frames import find_rest_frames
from dsar.avatar.template import VISIBLE_LOGIT, GaussianParameters
from dsar.body.atlas import Atlas, body_chart
from dsar.body.model import PARENTS
from dsar.body.skinning import forward_kinematics
from dsar.config import AtlasConfig, ModelConfig
from dsar.geometry.rotations import heading_matrix
from dsar.network import STREAMS, NetworkOutput, NetworkState, Stream, build_network
from dsar.network.variants.principal_poses import PrincipalPoses
from dsar.types import Body, Capture, Gaussians, Motion

_log = logging.getLogger(__name__)
GARMENT_FRAMES = 12
"""Still frames whose masks shape the garment chart."""


class Avatar(nn.Module):
    """A person who can be driven by any SMPL-X motion.

    A motion drives it as a *driving signal*, one step as a *motion window*; see `dsar.avatar.driving`.
    """

    texels: Tensor
    texel_weights: Tensor
    texel_positions: Tensor
    texel_hidden: Tensor
    control_cells: Tensor
    control_points: Tensor
    control_weights: Tensor
    control_frames: Tensor
    control_basis: Tensor
    texel_axes: Tensor
    control_axes: Tensor
    map_mean: Tensor
    map_scale: Tensor
    magnitude_scale: Tensor
    surface_edges: Tensor
    body_joints: Tensor
    bilinear_indices: Tensor
    bilinear_weights: Tensor

    def __init__(self, body: Body, atlas: Atlas, model: ModelConfig, fps: float) -> None:
        super().__init__()
        self.model, self.fps = model, fps
        for name in ("vertices", "faces", "joints", "weights", "uv", "uv_faces"):
            self.register_buffer(f"body_{name}", getattr(body, name))
        self.atlas_size = (atlas.height, atlas.width)
        self.register_buffer("texels", atlas.texels)
        self.register_buffer("texel_positions", atlas.positions)
        self.register_buffer("texel_weights", atlas.weights)
        self.register_buffer("texel_frames", atlas.frames)
        self.register_buffer("texel_tangents", atlas.tangents)
        self.register_buffer("texel_hidden", atlas.hidden)
        size = (atlas.height // model.upsample, atlas.width // model.upsample)
        cells, nearest = assign_control_cells(atlas, model.upsample)
        self.grid_size = size
        self.register_buffer("control_cells", cells)
        self.register_buffer("control_points", atlas.positions[nearest])
        self.register_buffer("control_weights", atlas.weights[nearest])
        self.register_buffer("control_frames", atlas.frames[nearest])
        basis = (
            self.control_weights[:, :, None]
            * nn.functional.pad(self.control_points, (0, 1), value=1.0)[:, None]
        )
        self.register_buffer("control_basis", basis.flatten(1), persistent=False)
        self.register_buffer(
            "surface_edges", find_surface_edges(cells, size, atlas.positions[nearest]), persistent=False
        )
        axes = atlas.frames if model.axes == "surface" else torch.eye(3).expand_as(atlas.frames)
        self.register_buffer("texel_axes", axes.contiguous(), persistent=False)
        self.register_buffer("control_axes", axes[nearest], persistent=False)
        rows, columns = atlas.texels // atlas.width, atlas.texels % atlas.width
        bilinear = bilinear_sampling(rows, columns, model.upsample, size, self._body_rows)
        self.register_buffer("bilinear_indices", bilinear[0], persistent=False)
        self.register_buffer("bilinear_weights", bilinear[1], persistent=False)
        self.register_buffer("map_mean", torch.zeros(model.map_channels, 1, 1))
        self.register_buffer("map_scale", torch.ones(model.map_channels, 1, 1))
        self.register_buffer("magnitude_scale", torch.ones(()))
        self.principal_poses = PrincipalPoses(model.pose_components, len(cells))
        occupied = torch.zeros(size[0] * size[1], dtype=torch.bool)
        occupied[cells] = True
        self.template = GaussianParameters(atlas.positions, atlas.tangents, atlas.hidden, model.sh_degree)
        self.network = build_network(model, occupied.reshape(size))

    @classmethod
    def from_capture(cls, capture: Capture, body: Body, atlas: AtlasConfig, model: ModelConfig) -> "Avatar":
        """Build an untrained avatar: atlas from body and silhouettes, input statistics from the motions."""
        motions = {name: capture.motions[name] for name in capture.splits["train"]}
        fps = next(iter(motions.values())).fps
        transforms = {n: forward_kinematics(body, m.rotations, m.translations) for n, m in motions.items()}
        charts, hidden = [body_chart(body, atlas.resolution)], None
        if atlas.garment == "auto":
            still = find_rest_frames(transforms, fps, GARMENT_FRAMES, 3, capture.cameras_with_image)
            pelvis = torch.stack([transforms[name][frame, 0] for name, frame in still])
            size = (atlas.garment_rows, atlas.resolution)
            chart = fit_garment_chart(body, capture, still, pelvis, size, atlas.weight_smoothing)
            if chart is not None:
                hidden = texels_beneath(body, chart, charts[0])
                charts.append(chart)
        avatar = cls(body, Atlas.stack(charts, hidden), model, fps)
        avatar.fit_input_statistics([avatar.driving_signal(motion) for motion in motions.values()])
        return avatar

    @property
    def body(self) -> Body:
        """The shaped body that drives the avatar."""
        names = ("vertices", "faces", "joints", "weights", "uv", "uv_faces")
        return Body(parents=PARENTS, **{name: getattr(self, f"body_{name}") for name in names})

    @property
    def _body_rows(self) -> int:
        """Rows of the atlas that its first chart fills, the body's square."""
        return self.atlas_size[1]

    @property
    def num_gaussians(self) -> int:
        """Gaussians of every frame."""
        return len(self.texels)

    def driving_signal(self, motion: Motion) -> Float[Tensor, "f t j 4 4"]:
        """Return the driving signal of a motion."""
        poses = motion.rotations.to(self.body_joints), motion.translations.to(self.body_joints)
        transforms, pelvis = forward_kinematics(self.body, *poses), self.body_joints[0]
        for frame in find_jumps(transforms, pelvis, motion.fps):
            _log.warning(
                "Motion %s: the body jumps at frame %d of %d (%.2f s); its clothes go with it",
                *(motion.name, frame, len(motion), frame / motion.fps),
            )
        return driving_signal(transforms, pelvis, motion.fps, self.model.mean_time_constants)

    def initial_state(self, batch: int = 1) -> NetworkState:
        """Return the state of rollouts that have seen nothing yet."""
        return self.network.initial_state(batch)

    def input_maps(self, motion_window: Float[Tensor, "b t j 4 4"], fps: float) -> InputMaps:
        """Return the network's input maps, in metres."""
        rows = motion_window[..., :3, :].transpose(-3, -2).flatten(-2)
        points = (rows @ self.control_basis.mT).mT
        pelvis = motion_window[:, 0, 0]
        roots = pelvis[:, :3, :3] @ self.body_joints[0] + pelvis[:, :3, 3]
        headings = heading_matrix(pelvis[:, :3, :3])
        if self.model.axes == "surface":
            axes = (
                blend_bone_transforms(self.control_weights, motion_window[:, :1])[:, 0, :, :, :3]
                @ self.control_frames
            )
        else:
            axes = headings[:, None].expand(-1, len(self.control_cells), -1, -1)
        return make_input_maps(
            points,
            headings,
            axes,
            roots,
            self.control_cells,
            self.grid_size,
            fps,
            velocity=self.model.velocity,
            acceleration=self.model.acceleration,
        )

    @torch.no_grad()
    def fit_input_statistics(self, signals: list[Float[Tensor, "_ t j 4 4"]]) -> None:
        """Set the statistics that standardise input maps from training motions."""
        maps, magnitudes = [], []
        for signal in signals:
            for frames in torch.arange(0, len(signal), 4).split(16):
                input_maps = self.input_maps(signal[frames], self.fps)
                maps.append(input_maps.maps.flatten(2)[:, :, self.control_cells])
                magnitudes.append(input_maps.magnitude.flatten(2)[:, :, self.control_cells])
        values = torch.cat(maps)
        # Positions are centred; velocities and the like keep their zero, which means rest.
        self.map_mean[:3] = values[:, :3].mean((0, 2))[:, None, None]
        deviation = (values - self.map_mean[:, 0]).square().mean((0, 2)).sqrt()
        self.map_scale.copy_(deviation.clamp_min(1e-3)[:, None, None])
        self.magnitude_scale.copy_(torch.cat(magnitudes).square().mean().sqrt().clamp_min(1e-3))
        self.principal_poses.fit(values[:, :3])

    def garment_control_points(self) -> Int64[Tensor, " g"]:
        """Return which control points lie on the garment's chart; none where there is no such chart."""
        rows = self.control_cells // self.grid_size[1] * self.model.upsample
        return (rows >= self._body_rows).nonzero().squeeze(1)

    def garment_texels(self) -> Int64[Tensor, " g"]:
        """Return which Gaussians lie on the garment's chart; none where there is no such chart."""
        return (self.texels // self.atlas_size[1] >= self._body_rows).nonzero().squeeze(1)

    @torch.no_grad()
    def unhide_covered_texels(self) -> None:
        """Show the body beneath garments as the nearest bare texel is; called once the template is fitted.

        Fitted along with the garment it would be painted like it, and when the cloth lifts, that paint
        stays behind.
        """
        if not self.texel_hidden.any():
            return
        body = self.texels // self.atlas_size[1] < self._body_rows
        bare = (body & ~self.texel_hidden).nonzero().squeeze(1)
        points = self.texel_positions
        source = bare[torch.cdist(points[self.texel_hidden], points[bare]).argmin(1)]
        self.template.harmonics[self.texel_hidden] = self.template.harmonics[source]
        self.template.opacity_logits[self.texel_hidden] = VISIBLE_LOGIT
        self.texel_hidden.fill_(False)

    def gather_control_points(self, offset: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b p 3"]:
        """Return a map's offsets at the control points, along their own axes, metres."""
        return offset.flatten(2)[:, :, self.control_cells].transpose(1, 2)

    def scatter_garment_points(self, offsets: Float[Tensor, "b g 3"]) -> Float[Tensor, "b p 3"]:
        """Return the garment's offsets among those of all control points, which stay where they are."""
        still = offsets.new_zeros(len(offsets), len(self.control_cells), 3)
        return still.index_copy(1, self.garment_control_points(), offsets)

    def offset_garment(self, offsets: Float[Tensor, "b g 3"]) -> NetworkOutput:
        """Return an output that moves the garment's control points by these offsets, and nothing else."""
        batch, (h, w) = len(offsets), self.grid_size
        moved = self.scatter_garment_points(offsets).transpose(1, 2)
        flat = offsets.new_zeros(batch, 3, h * w).index_copy(2, self.control_cells, moved)
        appearance = offsets.new_zeros(batch, self.model.appearance_channels, h, w)
        return NetworkOutput(flat.unflatten(2, (h, w)), appearance, ())

    def standardize(self, input_maps: InputMaps) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Return input maps and motion magnitude as the network takes them."""
        maps = self.principal_poses(input_maps.maps, self.control_cells)
        maps = (maps - self.map_mean) / self.map_scale * self.network.occupied
        return maps, input_maps.magnitude / self.magnitude_scale

    def forward_frame(
        self,
        motion_window: Float[Tensor, "b t j 4 4"],
        state: NetworkState,
        *,
        streams: Collection[Stream] = STREAMS,
    ) -> tuple[NetworkOutput, NetworkState, InputMaps]:
        """Run the network one frame on; return its output, the next state and the maps it saw."""
        input_maps = self.input_maps(motion_window, self.fps)
        output, state = self.network(*self.standardize(input_maps), state, streams=streams)
        return output, state, input_maps

    def gaussians(
        self, motion_window: Float[Tensor, "b t j 4 4"], output: NetworkOutput | None
    ) -> list[Gaussians]:
        """Return the posed Gaussians of each batch entry; without an output, the template's."""
        blended = blend_bone_transforms(self.texel_weights, motion_window[:, :1])[:, 0]
        if output is None:
            shape = (len(motion_window), 3 + self.model.appearance_channels, *self.grid_size)
            offset, appearance = blended.new_zeros(shape).split([3, shape[1] - 3], 1)
        else:
            offset, appearance = output.offset, output.appearance
        bilinear = (self.bilinear_indices, self.bilinear_weights)
        if blended.dtype == torch.float32 and blended.device.type == "cpu":
            return pose_fused(self.template, offset, appearance, bilinear, self.texel_axes, blended)
        offsets = (self.texel_axes * sample_bilinear(offset, bilinear)[..., None, :]).sum(-1)
        return pose_gaussians(self.template.activate(offsets, sample_bilinear(appearance, bilinear)), blended)

    def deformed_control_points(
        self, motion_window: Float[Tensor, "b t j 4 4"], output: NetworkOutput
    ) -> Float[Tensor, "b p 3"]:
        """Return the newest frame's control points, offset and posed, world metres."""
        offsets = self.gather_control_points(output.offset)
        points = self.control_points + (self.control_axes * offsets[..., None, :]).sum(-1)
        blended = blend_bone_transforms(self.control_weights, motion_window[:, :1])[:, 0]
        return (blended[..., :3] * points[..., None, :]).sum(-1) + blended[..., 3]

    def step(
        self, motion_window: Float[Tensor, "b t j 4 4"], state: NetworkState
    ) -> tuple[list[Gaussians], NetworkState]:
        """Advance rollouts by one frame: posed Gaussians of each, and the state to carry on."""
        output, state, _ = self.forward_frame(motion_window, state)
        return self.gaussians(motion_window, output), state


def blend_bone_transforms(
    weights: Float[Tensor, "n j"], transforms: Float[Tensor, "b t j 4 4"]
) -> Float[Tensor, "b t n 3 4"]:
    """Return the blended bone transforms of points, by frame."""
    return (weights @ transforms[..., :3, :].flatten(3)).unflatten(-1, (3, 4))


def assign_control_cells(atlas: Atlas, upsample: int) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"]]:
    """Return the network pixels that hold texels, and of each the texel nearest to its centre."""
    rows, columns = atlas.texels // atlas.width, atlas.texels % atlas.width
    width = atlas.width // upsample
    cell = rows // upsample * width + columns // upsample
    center = (upsample - 1) / 2
    distance = (rows % upsample - center).square() + (columns % upsample - center).square()
    order = (cell.double() * 1e6 + distance).argsort(stable=True)
    cells, counts = cell[order].unique_consecutive(return_counts=True)
    return cells, order[counts.cumsum(0) - counts]


def find_surface_edges(
    cells: Int64[Tensor, " p"], size: tuple[int, int], points: Float[Tensor, "p 3"]
) -> Int64[Tensor, "l 2"]:
    """Return the pairs of control points that are neighbours on the surface.

    They are neighbours on the grid, whose first column follows its last, and not much farther apart
    than is usual: a garment chart closes to a tube, and islands of the body's UV map stay apart.
    """
    height, width = size
    index = torch.full((height * width,), -1)
    index[cells] = torch.arange(len(cells))
    grid = index.reshape(size)
    pairs = [
        torch.stack([grid, grid.roll(-1, 1)], -1).reshape(-1, 2),
        torch.stack([grid[:-1], grid[1:]], -1).reshape(-1, 2),
    ]
    edges = torch.cat(pairs)
    edges = edges[(edges >= 0).all(1)]
    distance = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=1)
    return edges[distance <= 2 * distance.median()]
