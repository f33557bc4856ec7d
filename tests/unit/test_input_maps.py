"""Input maps of a body that moves as we know, against derivatives that NumPy takes of its closed form."""

import math

import numpy as np
import pytest
import torch

from dsar.avatar.charts import Atlas, body_chart
from dsar.avatar.control_grid import ControlGrid
from dsar.avatar.driving import DrivingSignal
from dsar.avatar.guards import LIMITS, Guard
from dsar.avatar.input_maps import REFERENCE_FPS, InputMaps, make_input_maps
from dsar.body.files import load_body
from dsar.config import ModelConfig
from dsar.types import Motion

BODY = load_body()
TIME_CONSTANTS = (0.1, 0.4)
FRAMES = 20
SPIN, SHIFT = 2.5, np.array([1.2, 0.3, -0.7])
"""Radians and metres per second: a stiff body that turns about the vertical while it is carried along."""
RATES = (30.0, 24.0)


def grid_of(axes: str) -> ControlGrid:
    return ControlGrid(Atlas.stack([body_chart(BODY, 32)]), 4, surface_axes=axes == "surface")


def angle_at(time: np.ndarray) -> np.ndarray:
    """Return the angle of the spin; it speeds up, so that there is an acceleration along the way, too."""
    return SPIN * time + 0.8 * time**2


def rotation(angle: float) -> np.ndarray:
    """Return the rotation about +Y that takes +Z towards +X."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def stiff_points(points: np.ndarray, time: float) -> np.ndarray:
    """Return where a stiff body has its points at a time; before 0 it stands in its first pose."""
    time, pelvis = max(time, 0.0), BODY.joints[0].double().numpy()
    return (points - pelvis) @ rotation(angle_at(time)).T + pelvis + SHIFT * time


def stiff_motion(fps: float, seconds_per_second: float = 1.0) -> Motion:
    times = torch.arange(FRAMES) / fps * seconds_per_second
    rotations = torch.zeros(FRAMES, 55, 3)
    rotations[:, 0, 1] = torch.from_numpy(angle_at(times.double().numpy())).float()
    translations = torch.from_numpy(times.double().numpy()[:, None] * SHIFT).float()
    return Motion(rotations, translations, fps, "stiff")


def make(grid: ControlGrid, motion: Motion, axes: str = "body", **changes: object) -> InputMaps:
    usual = {"axes": axes, "upsample": 4, "mean_time_constants": TIME_CONSTANTS, "prior": "none"}
    model = ModelConfig(**{**usual, **changes})  # pyright: ignore
    signal = DrivingSignal.of_motion(BODY, motion, model.mean_time_constants)
    return make_input_maps(grid, signal.windows, BODY.joints[0], motion.fps, model)


def channels(grid: ControlGrid, inputs: InputMaps) -> np.ndarray:
    """Return the maps at the control points: frame, group of three channels, point, component."""
    values = grid.gather(inputs.maps).double().numpy()
    return values.reshape(*values.shape[:2], -1, 3).transpose(0, 2, 1, 3)


def world_axes(grid: ControlGrid, axes: str, time: float) -> np.ndarray:
    """Return the axes (columns) along which vectors are given: the heading's, or the turned surface's."""
    turned = rotation(angle_at(max(time, 0.0)))
    if axes == "body":
        return np.broadcast_to(turned, (len(grid.cells), 3, 3))
    return turned @ grid.frames.double().numpy()


def along(axes: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("pij,pi->pj", axes, vectors)


@pytest.mark.parametrize("axes", ["body", "surface"])
@pytest.mark.parametrize("fps", RATES)
def test_every_channel_is_the_derivative_that_it_says(fps, axes):
    grid = grid_of(axes)
    rest = grid.points.double().numpy()
    inputs = make(grid, stiff_motion(fps), axes)
    found = channels(grid, inputs)
    magnitude = grid.gather(inputs.magnitude)[..., 0].double().numpy()
    pelvis, reference = BODY.joints[0].double().numpy(), 1 / REFERENCE_FPS
    for frame in range(FRAMES):
        times = [(frame - k) / fps for k in range(3)]
        here, before, earlier = (stiff_points(rest, time) for time in times)
        ground = (pelvis + SHIFT * times[0]) * [1, 0, 1]
        expected = (here - ground) @ rotation(angle_at(times[0]))
        assert np.abs(found[frame, 0] - expected).max() < 1e-5, "position"
        resolved = world_axes(grid, axes, times[0])
        velocity = (here - before) * fps * reference
        assert np.abs(found[frame, 1] - along(resolved, velocity)).max() < 1e-5, "velocity"
        change = (velocity - (before - earlier) * fps * reference) * fps * reference
        assert np.abs(found[frame, 2] - along(resolved, change)).max() < 2e-5, "acceleration"
        assert np.abs(magnitude[frame] - np.linalg.norm(velocity, axis=1)).max() < 1e-5, "magnitude"
    assert inputs.guard_counts[Guard.SPEED].sum() == 0


def test_a_velocity_is_that_of_the_closed_form_in_metres_per_thirtieth_of_a_second():
    """At a high rate differences meet the derivative: sign and unit are those of the world."""
    grid, fps = grid_of("body"), 3000.0
    inputs = make(grid, stiff_motion(fps))
    frame, rest, pelvis = FRAMES - 1, grid.points.double().numpy(), BODY.joints[0].double().numpy()
    time = (frame - 0.5) / fps
    speed = SPIN + 1.6 * time
    arm = (rest - pelvis) @ rotation(angle_at(time)).T
    # Omega x r, with omega along +Y.
    derivative = speed * np.stack([arm[:, 2], 0 * arm[:, 0], -arm[:, 0]], 1) + SHIFT
    expected = along(world_axes(grid, "body", frame / fps), derivative / REFERENCE_FPS)
    assert np.abs(channels(grid, inputs)[frame, 1] - expected).max() < 3e-3


@pytest.mark.parametrize("fps", RATES)
def test_a_lag_is_the_way_to_the_exponential_mean_of_the_past_without_the_pelvis_way(fps):
    grid = grid_of("body")
    rest, pelvis = grid.points.double().numpy(), BODY.joints[0].double().numpy()
    found = channels(grid, make(grid, stiff_motion(fps)))
    for frame in range(FRAMES):
        root = pelvis + SHIFT * frame / fps
        for index, seconds in enumerate(TIME_CONSTANTS):
            # The same as a sum over the whole past, of which the first frame lasted forever.
            decay = math.exp(-1 / (seconds * fps))
            shares = (1 - decay) * decay ** np.arange(frame + 1.0)
            shares[-1] = decay**frame
            past = [
                stiff_points(rest, (frame - k) / fps) - SHIFT * (frame - k) / fps for k in range(frame + 1)
            ]
            mean = np.einsum("k,kpc->pc", shares, np.array(past)) - pelvis + root
            way = mean - stiff_points(rest, frame / fps)
            expected = along(world_axes(grid, "body", frame / fps), way)
            assert np.abs(found[frame, 3 + index] - expected).max() < 2e-5


@pytest.mark.parametrize("fps", RATES)
def test_velocities_are_cut_at_twelve_metres_a_second_and_keep_their_direction(fps):
    grid, faster = grid_of("body"), 6.0
    rest = grid.points.double().numpy()
    inputs = make(grid, stiff_motion(fps, faster))
    found, magnitude = channels(grid, inputs), grid.gather(inputs.magnitude)[..., 0].double().numpy()
    cut = []
    for frame in range(1, FRAMES):
        times = [(frame - k) / fps * faster for k in range(2)]
        velocity = (stiff_points(rest, times[0]) - stiff_points(rest, times[1])) * fps / REFERENCE_FPS
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        expected = velocity * np.minimum(1, 0.4 / speed)
        resolved = along(world_axes(grid, "body", times[0]), expected)
        assert np.abs(found[frame, 1] - resolved).max() < 5e-5
        assert np.abs(magnitude[frame] - np.minimum(speed[:, 0], 0.4)).max() < 1e-5
        clear = np.abs(speed[:, 0] - 0.4) > 1e-5
        if clear.all():
            assert int(inputs.guard_counts[Guard.SPEED][frame]) == int((speed > 0.4).sum())
        cut.append(int((speed > 0.4).sum()))
    assert 0 < max(cut)
    assert LIMITS.speed * REFERENCE_FPS == 12.0


def test_a_lag_is_cut_at_a_metre_and_keeps_its_direction():
    grid = grid_of("body")
    # Long arms: a point two metres off the pelvis, half a turn from where it was.
    motion = Motion(torch.zeros(FRAMES, 55, 3), torch.zeros(FRAMES, 3), 30.0)
    for frame in range(FRAMES):
        motion.rotations[frame, 0, 0] = min(frame, 2) * 1.5
    free, model = make(grid, motion, mean_time_constants=(50.0,)), (50.0,)
    signal = DrivingSignal.of_motion(BODY, motion, model)
    rest = grid.points.double().numpy()
    weights = grid.weights.double().numpy()

    def posed(transforms: torch.Tensor) -> np.ndarray:
        blended = np.einsum("pj,jrc->prc", weights, transforms.double().numpy())
        return np.einsum("prc,pc->pr", blended[:, :3, :3], rest) + blended[:, :3, 3]

    way = posed(signal.windows[-1, 3]) - posed(signal.windows[-1, 0])
    length = np.linalg.norm(way, axis=1, keepdims=True)
    assert (length > 1).any()
    assert (length < 1).any()
    found = channels(grid, free)[-1, 3]
    assert np.abs(np.linalg.norm(found, axis=1) - np.minimum(length[:, 0], LIMITS.lag)).max() < 1e-4
    assert int(free.guard_counts[Guard.LAG][-1]) == int((length > 1).sum())


def test_cells_without_a_control_point_are_zero():
    grid = grid_of("body")
    inputs = make(grid, stiff_motion(30.0))
    assert not inputs.maps[:, :, ~grid.occupied].any()
    assert not inputs.magnitude[:, :, ~grid.occupied].any()


def test_the_motion_prior_comes_last_at_the_last_control_points_and_nowhere_else():
    grid, motion = grid_of("body"), stiff_motion(30.0)
    model = ModelConfig(axes="body", upsample=4, mean_time_constants=TIME_CONSTANTS)
    signal = DrivingSignal.of_motion(BODY, motion, model.mean_time_constants)
    cloth = torch.rand(FRAMES, 5, 6, generator=torch.Generator().manual_seed(0)) + 0.1
    maps = make_input_maps(grid, signal.windows, BODY.joints[0], 30.0, model, cloth).maps
    assert maps.shape[1] == model.map_channels
    assert torch.equal(maps[:, :-6], make(grid, motion).maps)
    prior = grid.gather(maps[:, -6:])
    assert torch.equal(prior[:, -5:], cloth)
    assert not prior[:, :-5].any()
    assert not maps[:, -6:, ~grid.occupied].any()


def test_a_model_with_a_motion_prior_takes_no_frames_without_it():
    with pytest.raises(ValueError, match="prior"):
        make(grid_of("body"), stiff_motion(30.0), prior="cloth")
