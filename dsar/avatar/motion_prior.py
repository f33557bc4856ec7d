"""The motion prior of an avatar: where a coarse simulation has its loose garments (extension).

A thousand frames teach a network little about motions that they do not show. But cloth obeys known laws: a
coarse simulation of the same garment, driven by the same motion, is half-way right on any motion. It enters
the network as input maps, and it is the base of the offset: the network learns what is left.

It follows from the motion alone, so a driving signal brings it along (`DrivingSignal.cloth`).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dsar.avatar.charts import Chart
from dsar.avatar.control_grid import ControlGrid
from dsar.avatar.input_maps import REFERENCE_FPS
from dsar.dynamics.cloth import ClothConstants
from dsar.dynamics.collider import BodyCollider
from dsar.dynamics.simulation import ClothSimulation, Fabric, Stage
from dsar.dynamics.tube import TubeSampling, average_tube, fit_tube, places_down, sample_tube
from dsar.types import Body

GRID = (9, 24)
"""Points of a simulated garment, down and around."""
CHANNELS = 6
"""Of a frame at each control point: offset, and its change since the frame before."""
HANGING_SECONDS = 3.0
"""Time at rest after which simulated cloth is taken to hang still."""


class GarmentPrior(nn.Module):
    """The simulation of one garment, and its way from the chart's texels and to the control points."""

    rest: Tensor
    """Resting points, metres: [r, c, 3]."""
    weights: Tensor
    """Their skin weights: [r, c, j]."""
    hanging: Tensor
    """Displacement from home in which the simulated cloth hangs at rest, metres: [r * c, 3]."""
    constants: Tensor
    """`ClothConstants` as a vector."""
    trust: Tensor
    """Share of the prior that is the offset's base, from the top row to the hem: [r]."""
    axes: Tensor

    def __init__(self, chart: Chart, control: ControlGrid, upsample: int, width: int) -> None:
        """Prepare for the garment of a chart.

        Args:
            chart: In texel rows of the atlas.
            control: The avatar's control points.
            upsample: Texels of a cell of the control grid, each way.
            width: Texel columns of the atlas.
        """
        super().__init__()
        self.size = (len(chart.rows), width)
        on_chart = control.on_charts([chart.downsampled(upsample)])
        rows, columns = control.cells[on_chart] // control.size[1], control.cells[on_chart] % control.size[1]
        centres = [(place + 0.5) * upsample - 0.5 for place in (rows.float(), columns.float())]
        self._control = centres[0] - chart.rows.start, centres[1]
        sampling = self._sampling_at(torch.linspace(0, GRID[0] - 1, self.size[0]))
        self.register_buffer("indices", sampling.indices)
        self.register_buffer("sampling_weights", sampling.weights)
        self.register_buffer("axes", control.axes[on_chart], persistent=False)
        self.register_buffer("rest", torch.zeros(*GRID, 3))
        self.register_buffer("weights", torch.zeros(*GRID, control.weights.shape[1]))
        self.register_buffer("hanging", torch.zeros(GRID[0] * GRID[1], 3))
        self.register_buffer("constants", torch.from_numpy(ClothConstants().to_vector()))
        self.register_buffer("trust", torch.zeros(GRID[0]))
        self._collider: tuple[tuple[float, float], BodyCollider] | None = None

    @property
    def sampling(self) -> TubeSampling:
        """How control points are sampled from the simulated grid."""
        return TubeSampling(self.get_buffer("indices"), self.get_buffer("sampling_weights"))

    @property
    def placed(self) -> bool:
        """Whether the garment's rest shape is known."""
        return bool(self.weights.any())

    def place(self, positions: Float[Tensor, "n 3"], weights: Float[Tensor, "n j"]) -> None:
        """Set the rest shape and the skin weights from all texels of the chart, row by row."""
        positions, weights = positions.cpu(), weights.cpu()  # once a run, for many small operations
        points = positions.unflatten(0, self.size)
        places = places_down(points, GRID[0])
        self.rest.copy_(fit_tube(points, places, GRID))
        blended = average_tube(weights.unflatten(0, self.size), places, GRID)
        self.weights.copy_(blended / blended.sum(-1, keepdim=True))
        sampling = self._sampling_at(places)
        self.get_buffer("indices").copy_(sampling.indices)
        self.get_buffer("sampling_weights").copy_(sampling.weights)

    def _sampling_at(self, places: Float[Tensor, " h"]) -> TubeSampling:
        """Return how control points are sampled where texel rows lie at some places among the grid's."""
        rows, columns = self._control
        above = rows.floor().long().clamp(0, max(len(places) - 2, 0))
        below = (above + 1).clamp_max(len(places) - 1)
        down = torch.lerp(places[above], places[below], (rows - above).clamp(0, 1))
        return sample_tube(down, columns, self.size[1], GRID)

    def simulation(self, body: Body) -> ClothSimulation:
        """Return the simulation of the garment on a body."""
        rest = self.rest.cpu()
        extent = (float(rest[..., 1].max()), float(rest[..., 1].min()))
        # Kept from motion to motion; a loaded or fitted garment may reach elsewhere.
        if self._collider is None or self._collider[0] != extent:
            self._collider = extent, BodyCollider(body.to(device="cpu"), *extent)
        return ClothSimulation(self._collider[1], rest, self.weights.cpu())

    @property
    def fabric_constants(self) -> ClothConstants:
        """What kind of cloth it is."""
        return ClothConstants.from_vector(self.constants.cpu().numpy())

    def along_axes(self, offsets: Float[Tensor, "f n 3"]) -> Float[Tensor, "f g 3"]:
        """Return displacements of the grid's points at the control points, along their axes."""
        return (self.axes * self.sampling(offsets)[..., :, None]).sum(-2)


def hang(simulation: ClothSimulation, fabric: Fabric, stages: Sequence[Stage], fps: float) -> Tensor:
    """Return the mean displacement, [n, 3], in which cloth hangs still around the first frame of motions."""
    frames = round(HANGING_SECONDS * fps)
    hung = [simulation.displacements(stage.held(frames), fabric, fps)[-1] for stage in stages]
    return torch.stack(hung).mean(0)


class MotionPrior(nn.Module):
    """The simulations of all loose garments of an avatar."""

    def __init__(self, charts: Sequence[Chart], control: ControlGrid, upsample: int, width: int) -> None:
        """Prepare for the garments of some charts, in texel rows of the atlas."""
        super().__init__()
        self.tubes = nn.ModuleList(GarmentPrior(chart, control, upsample, width) for chart in charts)

    @property
    def garments(self) -> list[GarmentPrior]:
        """The simulations, in the order of their charts."""
        return [tube for tube in self.tubes if isinstance(tube, GarmentPrior)]

    @property
    def placed(self) -> bool:
        """Whether all garments' rest shapes are known."""
        return all(garment.placed for garment in self.garments)

    @torch.no_grad()
    def simulate(
        self, body: Body, transforms: Float[Tensor, "f j 4 4"], fps: float
    ) -> Float[Tensor, "f g 6"]:
        """Return offset and its change at the garments' control points, along their axes, by frame.

        Before its first frame the body is taken to have stood in it. Zeros until the rest shape is known.

        Args:
            body: Who moves.
            transforms: T_world_rest of its joints, without jumps.
            fps: Frames a second.
        """
        every = [self._simulate_garment(garment, body, transforms, fps) for garment in self.garments]
        return torch.cat(every, 1)

    def _simulate_garment(
        self, garment: GarmentPrior, body: Body, transforms: Float[Tensor, "f j 4 4"], fps: float
    ) -> Float[Tensor, "f g 6"]:
        if not garment.placed:
            return transforms.new_zeros(len(transforms), len(garment.axes), CHANNELS)
        # Simulated in main memory, whatever the avatar's device: the solver is compiled for it.
        simulation = garment.simulation(body)
        fabric = simulation.fabric(garment.fabric_constants)
        hanging = garment.hanging.cpu()
        displaced = simulation.follow(transforms.cpu(), fabric, fps, hanging)
        offsets = garment.along_axes((displaced - hanging).to(transforms))
        change = torch.cat([torch.zeros_like(offsets[:1]), offsets.diff(dim=0)]) * (fps / REFERENCE_FPS)
        return torch.cat([offsets, change], -1)

    def base(self, cloth: Float[Tensor, "b g 6"]) -> Float[Tensor, "b g 3"]:
        """Return the offsets that the network starts from: as much of the prior as is trusted."""
        trust = [g.sampling(g.trust.repeat_interleave(GRID[1])[:, None]) for g in self.garments]
        return cloth[..., :3] * torch.cat(trust)
