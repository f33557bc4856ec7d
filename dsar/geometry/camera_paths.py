"""Cameras over time: at rest, keyed at frames, and three that are made around a moving person."""

import dataclasses
import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float

from dsar.geometry.cameras import look_at
from dsar.geometry.rotations import axis_angle_from_matrix, heading_matrix, matrix_from_axis_angle
from dsar.types import Binding, Camera

TURNTABLE, ORBIT, DOLLY = "turntable", "orbit", "dolly"
"""Names of the cameras that are made here, beside those of a capture's."""
PERIOD_S = 8.0
"""Seconds of one turn of the turntable and of the orbit."""
START_FRAME = 1001
"""Number of a motion's first frame at every rate, as film pipelines count."""
_DISTANCE = 2.6
"""The turntable's distance from the person, in heights of the person."""
_MARGIN = 1.35
"""Height of its picture there in heights of the person: room for arms and jumps. Makes everyone's lens."""
_ELEVATION = math.radians(8)
_ROOM = 1.12
"""How much larger than what must be seen the pictures of orbit and dolly are: cloth, hair, headroom."""
_CLOSE_HEIGHT, _CLOSE_WIDTH = 0.42, 0.34
"""What a medium close-up shows at least, in heights of the person: from above the head to mid-chest, and both
shoulders."""
_CLOSE_TARGET = 0.16
"""How far its middle lies below the crown, in heights of the person: at the chin."""
_SLACK = 0.08
"""Share of the picture that the person may move off its middle before the dolly goes with them."""
_STEADINESS_S = 0.4
"""Standard deviation, in seconds, over which the dolly's following is smoothed."""


@dataclass(frozen=True)
class CameraPath:
    """A camera over time: at rest, or keyed at frame numbers and interpolated between them, held outside."""

    cameras: tuple[Camera, ...]
    """Views of one name and size."""
    frames: tuple[float | int, ...] = ()
    """Frame numbers or times between, ascending, one per camera; empty for one camera at rest."""

    def __post_init__(self) -> None:
        """Check that the keys are those of one camera."""
        if len({(camera.name, camera.width, camera.height) for camera in self.cameras}) != 1:
            raise ValueError("a camera path needs cameras of one name and size, at least one")
        if len(self.cameras) != (len(self.frames) or 1):
            raise ValueError(f"a camera path of {len(self.cameras)} cameras has {len(self.frames)} frames")
        if any(later <= earlier for earlier, later in pairwise(self.frames)):
            raise ValueError(f"a camera path's frames do not ascend: {self.frames[:8]}")

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.cameras[0].name

    def at(self, time: float | int) -> Camera:
        """Return the camera at a time in frame numbers.

        At a key it is the keyed camera itself. Between keys its centre and intrinsics go straight from one to
        the next and it turns at a constant rate; before the first and after the last key it stands still.
        """
        after = bisect_left(self.frames, time)
        if after == len(self.frames):
            return self.cameras[-1]
        if after == 0 or self.frames[after] == time:
            return self.cameras[after]
        first, last = self.frames[after - 1 : after + 1]
        return _between(self.cameras[after - 1], self.cameras[after], (time - first) / (last - first))

    def around(self, frame: int) -> "CameraPath":
        """Return the part that is needed for times from the frame before to the one after, equal there."""
        if not self.frames:
            return self
        start = max(bisect_right(self.frames, frame - 1) - 1, 0)
        stop = bisect_left(self.frames, frame + 1) + 1
        return CameraPath(self.cameras[start:stop], self.frames[start:stop])

    def resized(self, width: int, height: int) -> "CameraPath":
        """Return the same views sampled at another resolution."""
        return dataclasses.replace(self, cameras=tuple(c.resized(width, height) for c in self.cameras))


def turntable(
    binding: Binding, frame_numbers: Sequence[int], fps: float, *, width: int, height: int
) -> CameraPath:
    """Return a camera that circles a person.

    It looks at the middle of the body, goes where the pelvis goes, and starts in front (+Z) at frame 1001.

    Args:
        binding: The body and its joints by frame.
        frame_numbers: As many as the binding has frames.
        fps: Frames per second.
        width: Pixels.
        height: Pixels.
    """
    lowest, highest = _rest_range(binding)
    middle = np.array([0.0, (lowest + highest) / 2 - float(binding.body.joints[0, 1]), 0.0])
    targets = _pelvis(binding) + middle
    places = targets + _DISTANCE * (highest - lowest) * _circle(frame_numbers, fps)
    return _path(TURNTABLE, places, targets, frame_numbers, width, height)


def orbit(
    binding: Binding, frame_numbers: Sequence[int], fps: float, *, width: int, height: int
) -> CameraPath:
    """Return a camera that circles the middle of a whole motion and sees all of it at any time.

    It does not follow the person, so that what moves in the picture moves in the world. It starts in front
    (+Z) at frame 1001.

    Args:
        binding: The body and its joints by frame of the whole motion.
        frame_numbers: As many as the binding has frames.
        fps: Frames per second.
        width: Pixels.
        height: Pixels.
    """
    points = _outline(binding).reshape(-1, 3)
    middle = (points.min(0) + points.max(0)) / 2
    distance = _orbit_distance(points - middle, _half_picture(width, height) / _ROOM)
    places = middle + distance * _circle(frame_numbers, fps)
    return _path(ORBIT, places, np.broadcast_to(middle, places.shape), frame_numbers, width, height)


def dolly(
    binding: Binding, frame_numbers: Sequence[int], fps: float, *, width: int, height: int
) -> CameraPath:
    """Return a camera in front of a person that moves in, from all of the body to head and chest.

    It keeps level, looks against the body's heading in the first frame, and sets off and arrives smoothly
    with the motion. Its distance is from where the person is; sideways and in height it goes with them only
    as far as they would otherwise leave the middle of the picture.

    Args:
        binding: The body and its joints by frame of the whole motion.
        frame_numbers: As many as the binding has frames.
        fps: Frames per second.
        width: Pixels.
        height: Pixels.
    """
    half = _half_picture(width, height)
    # Columns: to the person's left, which is the picture's right; up; from the person to the camera.
    axes = heading_matrix(binding.T_world_rest[0, 0, :3, :3].double()).cpu().numpy()
    pelvis = _pelvis(binding) @ axes
    first = (_outline(binding)[0] @ axes) - pelvis[0]
    lowest, highest = _rest_range(binding)
    tall = highest - lowest
    far_aim = np.array([0.0, (first[:, 1].min() + first[:, 1].max()) / 2, 0.0])
    close_aim = np.array([0.0, highest - _CLOSE_TARGET * tall - float(binding.body.joints[0, 1]), 0.0])
    seen = first - far_aim
    far = (np.abs(seen[:, :2]) * _ROOM / half + seen[:, 2:]).max()
    close = (np.array([_CLOSE_WIDTH, _CLOSE_HEIGHT]) * tall / 2 / half).max()
    share = _eased(frame_numbers)[:, None]
    distances = far + share * (close - far)
    drift = pelvis - pelvis[0]
    slack = np.concatenate([2 * _SLACK * half * distances, np.zeros_like(distances)], 1)
    steps = float(np.median(np.diff(frame_numbers))) if len(frame_numbers) > 1 else 1.0
    followed = _steady(drift - drift.clip(-slack, slack), _STEADINESS_S * fps / steps)
    targets = pelvis[0] + far_aim + share * (close_aim - far_aim) + followed
    places = targets + distances * np.array([0.0, 0.0, 1.0])
    return _path(DOLLY, places @ axes.T, targets @ axes.T, frame_numbers, width, height)


def _between(one: Camera, two: Camera, share: float) -> Camera:
    start, end = one.T_camera_world.double(), two.T_camera_world.double()
    rotation_vector = axis_angle_from_matrix(end[:3, :3] @ start[:3, :3].T)
    rotation = matrix_from_axis_angle(share * rotation_vector) @ start[:3, :3]
    center, goal = (-transform[:3, :3].T @ transform[:3, 3] for transform in (start, end))
    transform = torch.eye(4, dtype=torch.float64, device=start.device)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ torch.lerp(center, goal, share)
    K = torch.lerp(one.K.double(), two.K.double(), share)
    return dataclasses.replace(one, K=K.to(one.K), T_camera_world=transform.to(one.T_camera_world))


def _path(
    name: str,
    places: Float[np.ndarray, "f 3"],
    targets: Float[np.ndarray, "f 3"],
    frame_numbers: Sequence[int],
    width: int,
    height: int,
) -> CameraPath:
    """Return upright cameras of the lens that all paths share."""
    focal = _focal(height)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    views = (look_at(place, target) for place, target in zip(places, targets, strict=True))
    cameras = tuple(Camera(K, view, width, height, name) for view in views)
    return CameraPath(cameras, tuple(frame_numbers))


def _focal(height: int) -> float:
    return height * _DISTANCE / _MARGIN


def _half_picture(width: int, height: int) -> Float[np.ndarray, "2"]:
    """Return half the picture's width and height at a distance of one."""
    return np.array([width, height]) / 2 / _focal(height)


def _circle(frame_numbers: Sequence[int], fps: float) -> Float[np.ndarray, "f 3"]:
    """Return the directions in which a camera that circles stands."""
    angles = 2 * math.pi * (np.asarray(frame_numbers) - START_FRAME) / (fps * PERIOD_S)
    level, up = math.cos(_ELEVATION), math.sin(_ELEVATION)
    return np.stack([np.sin(angles) * level, np.full(angles.shape, up), np.cos(angles) * level], -1)


def _rest_range(binding: Binding) -> tuple[float, float]:
    """Return the heights of soles and crown at rest."""
    heights = binding.body.vertices[:, 1]
    return float(heights.min()), float(heights.max())


def _pelvis(binding: Binding) -> Float[np.ndarray, "f 3"]:
    transforms = binding.T_world_rest[:, 0]
    places = transforms[:, :3, :3] @ binding.body.joints[0] + transforms[:, :3, 3]
    return places.double().cpu().numpy()


def _outline(binding: Binding) -> Float[np.ndarray, "f c 3"]:
    """Return points around the person by frame: corners of the boxes at rest that each joint carries.

    They stand for all Gaussians, of which there are a thousand times as many.
    """
    points, carriers = binding.points.double(), binding.weights.argmax(1)
    joints = carriers.unique()
    boxes = []
    for joint in joints:
        own = points[carriers == joint]
        boxes.append(torch.cartesian_prod(*torch.stack([own.amin(0), own.amax(0)], 1)))
    transforms = binding.T_world_rest[:, joints].double()
    placed = torch.einsum("fjab,jcb->fjca", transforms[..., :3, :3], torch.stack(boxes))
    return (placed + transforms[..., None, :3, 3]).flatten(1, 2).cpu().numpy()


def _orbit_distance(points: Float[np.ndarray, "n 3"], half: Float[np.ndarray, "2"]) -> float:
    """Return the least distance from the origin from which a circling camera sees all points from all sides.

    A camera that goes round sees a point go round: across by r sin t, towards it by r cos t. Over all t, what
    the picture's width asks for is largest where the derivative vanishes, what its height asks for at an end,
    where the point is nearest or farthest.
    """
    level, up = math.cos(_ELEVATION), math.sin(_ELEVATION)
    radius, y = np.hypot(points[:, 0], points[:, 2]), points[:, 1]
    across = radius * math.hypot(1 / half[0], level) + y * up
    nearest = [np.abs(y * level - side * up) / half[1] + side * level + y * up for side in (radius, -radius)]
    return float(max(values.max() for values in (across, *nearest)))


def _eased(frame_numbers: Sequence[int]) -> Float[np.ndarray, " f"]:
    """Return the share of the way at each frame: 0 at the first, 1 at the last, at rest at both."""
    frames = np.asarray(frame_numbers, np.float64)
    share = (frames - frames[0]) / max(frames[-1] - frames[0], 1.0)
    return share * share * (3 - 2 * share)


def _steady(track: Float[np.ndarray, "f 3"], deviation: float) -> Float[np.ndarray, "f 3"]:
    """Return a track smoothed over time, by a Gaussian of a standard deviation in samples."""
    reach = max(1, math.ceil(3 * deviation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    # Turned about its ends a track keeps its course there: one that held would lag behind at the last frame.
    padded = np.pad(track, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    columns = [np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T]
    return np.stack(columns, 1)
