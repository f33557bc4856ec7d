"""Cameras of any USD stage as ours: the inverse of `cameras`.

Imports pxr: only `dsar_exporters.usd` imports this module, when it reads.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

import logging
import math
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from pxr import Gf, Usd, UsdGeom

from dsar.errors import ExportError
from dsar.geometry.camera_checks import RIGID_TOLERANCE, distance_from_orthonormal
from dsar.geometry.camera_paths import START_FRAME, CameraPath
from dsar.geometry.frame_rates import exact_rate, same_rate
from dsar.geometry.rotations import nearest_rotation
from dsar.types import Camera
from dsar_exporters.usd.camera_names import find_cameras, with_ancestors

_logger = logging.getLogger(__name__)

_FITS = 0.01
"""How far the aspects of aperture and picture may differ and mean the same: rounding to whole pixels."""
_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_STATE = 5
"""Numbers of a lens, before the sixteen of its place."""


def list_cameras(path: Path) -> list[str]:
    """Return the names of a stage's cameras; see `dsar_exporters.usd.list_usd_cameras`."""
    return list(find_cameras(path)[1])


def read_cameras(
    path: Path,
    frames: Sequence[int],
    resolution: tuple[int, int] | None,
    fps: float | None,
    chosen: Collection[str] | None,
) -> list[CameraPath]:
    """Read cameras; see `dsar_exporters.usd.read_usd_cameras`."""
    stage, prims = find_cameras(path)
    if not stage.HasAuthoredMetadata("metersPerUnit"):
        _logger.warning("%s: says no metersPerUnit; read in centimetres, as USD has it", path)
    return [
        _CameraReader(prim, name, f"{path}, camera {prim.GetPath()}").read(frames, resolution, fps)
        for name, prim in prims.items()
        if chosen is None or name in chosen
    ]


class _CameraReader:
    """One camera prim, and how errors call it."""

    def __init__(self, prim: Usd.Prim, name: str, where: str) -> None:
        self._prim, self._name, self._where = prim, name, where
        self._schema = UsdGeom.Camera(prim)
        self._xforms = [UsdGeom.Xformable(p) for p in with_ancestors(prim) if p.IsA(UsdGeom.Xformable)]
        self._lens = [
            self._schema.GetFocalLengthAttr(),
            self._schema.GetHorizontalApertureAttr(),
            self._schema.GetVerticalApertureAttr(),
            self._schema.GetHorizontalApertureOffsetAttr(),
            self._schema.GetVerticalApertureOffsetAttr(),
        ]

    def read(
        self, frames: Sequence[int], resolution: tuple[int, int] | None, fps: float | None
    ) -> CameraPath:
        """Return the camera: at rest, or keyed at frames and their neighbours, or around these."""
        size = self._size(resolution)
        keys = sorted({frame + step for frame in frames for step in (-1, 0, 1)})
        ratio = self._ratio(fps) if self._may_move() else 1.0
        if ratio != 1:
            # The stage's own time codes around the keys: between them USD may interpolate matrices, which
            # shears what rotates, and a path rotates.
            times = [START_FRAME + (key - START_FRAME) / ratio for key in keys]
            keys = sorted({math.floor(time) + step for time in times for step in (0, 1)})
        if not (self._may_move() and self._moves_at(keys)):
            return CameraPath((self._camera(self._states(keys[:1])[0], size),))
        cameras = tuple(self._camera(state, size) for state in self._states(keys))
        if ratio == 1:
            return CameraPath(cameras, tuple(keys))
        _logger.info(
            "%s: moves at %g time codes a second, taken by seconds for %g frames: frame %d is time code %d",
            *(self._where, _rate(self._prim.GetStage()), fps, START_FRAME, START_FRAME),
        )
        return CameraPath(cameras, tuple(START_FRAME + (key - START_FRAME) * ratio for key in keys))

    def _ratio(self, fps: float | None) -> float:
        """Return how many frames pass while a time code does; 1 where the stage says nothing of a rate."""
        rate = _rate(self._prim.GetStage())
        if rate is None or fps is None or same_rate(rate, fps):
            return 1.0
        if not 0 < rate < math.inf:
            raise ExportError(f"{self._where}: expected time codes per second > 0, found {rate:g}: set them")
        return float(exact_rate(fps) / exact_rate(rate))

    def _may_move(self) -> bool:
        return any(attribute.ValueMightBeTimeVarying() for attribute in self._lens) or any(
            xform.TransformMightBeTimeVarying() for xform in self._xforms
        )

    def _moves_at(self, keys: Sequence[int]) -> bool:
        """Return whether the camera moves at some time codes; say so where it does at others alone."""
        if _constant(self._states([*keys, *self._sample_times()])):
            return False
        if not _constant(self._states(keys)):
            return True
        times = self._sample_times()
        span = f"{times[0]:g} to {times[-1]:g}" if times else "other times"
        _logger.warning("%s: moves at %s, stands still at %d to %d", self._where, span, keys[0], keys[-1])
        return False

    def _sample_times(self) -> list[float]:
        return sorted({time for source in (*self._lens, *self._xforms) for time in source.GetTimeSamples()})

    def _states(self, times: Sequence[float | int]) -> Float[np.ndarray, "t 21"]:
        """Return lens and place at times: focal length, apertures, their offsets, local-to-world matrix."""
        # Also what stands still is read at a time: single samples are at no default.
        views = [self._schema.GetCamera(Usd.TimeCode(time)) for time in times]
        if any(view.projection != Gf.Camera.Perspective for view in views):
            raise ExportError(
                f"{self._where}: expected a perspective camera, found an orthographic one: make it "
                "perspective, or choose others with --camera NAME"
            )
        return np.array(
            [
                [
                    *(view.focalLength, view.horizontalAperture, view.verticalAperture),
                    *(view.horizontalApertureOffset, view.verticalApertureOffset),
                    *np.array(view.transform).ravel(),
                ]
                for view in views
            ]
        )

    def _camera(self, state: Float[np.ndarray, "21"], size: tuple[int, int]) -> Camera:
        intrinsics = torch.from_numpy(self._intrinsics(state[:_STATE], size)).float()
        transform = torch.from_numpy(self._transform(state[_STATE:].reshape(4, 4))).float()
        return Camera(intrinsics, transform, *size, self._name)

    def _intrinsics(self, lens: Float[np.ndarray, "5"], size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
        focal, horizontal, vertical, right, up = lens
        if not (lens[:3] > 0).all():
            raise ExportError(
                f"{self._where}: expected focalLength, horizontalAperture and verticalAperture > 0, found "
                f"{focal:g}, {horizontal:g} and {vertical:g}: set its lens"
            )
        width, height = size
        fx = fy = width * focal / horizontal
        if self._fits(horizontal / vertical, width / height):
            fy = height * focal / vertical
        cx, cy = width / 2 - right * fx / focal, height / 2 + up * fy / focal
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def _fits(self, aperture: float, picture: float) -> bool:
        """Return whether the picture shows all of the aperture, else its width alone counts.

        Pixels that are not square make the aspects differ; the resolution that we note tells of them.
        """
        own = self._noted_resolution()
        aspects = [aperture] if own is None else [aperture, own[0] / own[1]]
        return any(abs(aspect / picture - 1) <= _FITS for aspect in aspects)

    def _noted_resolution(self) -> tuple[int, int] | None:
        """Return the resolution that `define_camera` noted."""
        resolution = self._prim.GetCustomDataByKey("dsar:resolution")
        return None if resolution is None else (int(resolution[0]), int(resolution[1]))

    def _size(self, resolution: tuple[int, int] | None) -> tuple[int, int]:
        size = resolution or self._noted_resolution()
        if size is None:
            raise ExportError(
                f"{self._where}: expected a resolution, found none in the file: give --res WIDTH HEIGHT"
            )
        return size

    def _transform(self, matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Return T_camera_world in metres, Y up, of a local-to-world matrix for row vectors."""
        stage = self._prim.GetStage()
        axes, center = matrix[:3, :3].T, matrix[3, :3] * UsdGeom.GetStageMetersPerUnit(stage)
        scale = np.cbrt(np.linalg.det(axes))
        if not (scale > 0 and distance_from_orthonormal(axes.T / scale) <= RIGID_TOLERANCE):
            lengths = ", ".join(f"{length:g}" for length in np.linalg.norm(axes, axis=0))
            raise ExportError(
                f"{self._where}: expected it turned, moved and scaled alike in all directions, found it "
                f"mirrored, stretched or sheared (lengths of its axes {lengths}; determinant "
                f"{scale**3:g}): take the scale off the camera and its parents"
            )
        # The camera's scale changes nothing of what it sees.
        rotation = nearest_rotation(torch.from_numpy(axes / scale)).numpy()
        if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
            rotation, center = _Y_UP_FROM_Z_UP @ rotation, _Y_UP_FROM_Z_UP @ center
        rotation = (rotation * [1.0, -1.0, -1.0]).T
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = rotation, -rotation @ center
        return result


def _rate(stage: Usd.Stage) -> float | None:
    """Return the time codes per second, if the stage says how many."""
    states_rate = any(stage.HasAuthoredMetadata(f"{unit}PerSecond") for unit in ("timeCodes", "frames"))
    return stage.GetTimeCodesPerSecond() if states_rate else None


def _constant(states: Float[np.ndarray, "t 21"]) -> bool:
    # Between equal samples interpolation may round.
    return np.allclose(states, states[0], rtol=1e-9, atol=1e-12)
