"""EXR sequences: which files a picture becomes, what is in each, and whether one is there already."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dsar.atomic_files import atomic_write
from dsar.errors import ExportError, StorageError
from dsar.types import Camera, Picture
from dsar_exporters.checks import check_name
from dsar_exporters.color import ColorTarget
from dsar_exporters.exr.channels import color_channels, crop, data_channels
from dsar_exporters.exr.completeness import is_complete
from dsar_exporters.exr.cryptomatte import matte_metadata
from dsar_exporters.exr.deep import deep_channels
from dsar_exporters.exr.header import NO_COLOR, Window, make_header, openexr

Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]
Views = Literal["separate", "multipart"]
_LOSSY = ("pxr24", "b44", "b44a", "dwaa", "dwab")


def exr_path(folder: Path, *, name: str, camera: str, frame: int) -> Path:
    """Return the path of an image in a sequence: `folder/<camera>/<name>.<camera>.<frame, 4 digits>.exr`."""
    return folder / camera / f"{name}.{camera}.{frame:04d}.exr"


@dataclass(frozen=True)
class ExrSequence:
    """Image sequences for a compositor: R, G, B, A half, scene-linear, premultiplied; data channels lossless.

    `folder/<camera>/<name>.<camera>.%04d.exr`, deep ones `<name>_deep.<camera>.%04d.exr` beside them; with
    views in parts of one file `folder/<name>.%04d.exr`.
    """

    folder: Path
    name: str = "avatar"
    layers: tuple[str, ...] = ("rgba", "Z")
    """Of `rgba`, `alpha`, `Z`, `N`, `P`, `motion`, `id`, `crypto`."""
    target: ColorTarget = field(default_factory=ColorTarget)
    compression: Compression = "zips"
    views: Views = "separate"
    """A file a camera, or all cameras as parts of one."""
    crop: bool = False
    """Whether files hold only the pixels around the person (the data window)."""

    def __post_init__(self) -> None:
        """Check the name, and that there is a library to write with."""
        check_name("name", self.name)
        openexr()

    @property
    def key(self) -> str:
        """All settings that files depend on, besides their place."""
        return repr((self.name, self.layers, self.target.key, self.compression, self.views, self.crop))

    @property
    def together(self) -> bool:
        """Whether all cameras of a frame go into one file."""
        return self.views == "multipart"

    def check(self, cameras: Sequence[Camera]) -> None:
        """Check that cameras can be written together.

        Raises:
            ExportError: A name is no identifier, or sizes differ among the parts of one file.
        """
        for camera in cameras:
            check_name("camera name", camera.name)
        sizes = sorted({(camera.width, camera.height) for camera in cameras})
        if self.together and len(sizes) > 1:
            raise ExportError(
                f"--exr-views multipart: expected cameras of one size, found {sizes}: give one with --res"
            )

    def write(self, pictures: Sequence[Picture], jobs: Sequence[str]) -> list[Path]:
        """Write a frame's pictures and return the files, which appear when they are complete.

        Args:
            pictures: One a camera.
            jobs: For each the hash of all that its file depends on; see `complete`.
        """
        parts = [self.parts(picture, job) for picture, job in zip(pictures, jobs, strict=True)]
        if self.together:
            path = self._path(pictures[0].frame, None)
            write_parts(path, [part for each in parts for part in each])
            written = [path]
        else:
            written = [self._path(each.frame, each.camera.name) for each in pictures]
            for path, each in zip(written, parts, strict=True):
                write_parts(path, each)
        for picture, job in zip(pictures, jobs, strict=True):
            if picture.deep is not None:
                path = self._deep_path(picture.frame, picture.camera.name)
                write_parts(path, [self._deep_part(picture, job)])
                written.append(path)
        return written

    def complete(self, frame: int, cameras: Sequence[str], jobs: Sequence[str], deep: bool) -> bool:
        """Return whether a frame's files are there, whole, and from these very jobs."""
        views = list(zip(cameras, jobs, strict=True))
        files = {self._path(frame, None): views} if self.together else {}
        for view in views:
            if not self.together:
                files[self._path(frame, view[0])] = [view]
            if deep:
                files[self._deep_path(frame, view[0])] = [view]
        return all(_holds(path, expected) for path, expected in files.items())

    def _path(self, frame: int, camera: str | None) -> Path:
        if camera is None:
            return self.folder / f"{self.name}.{frame:04d}.exr"
        return exr_path(self.folder, name=self.name, camera=camera, frame=frame)

    def _deep_path(self, frame: int, camera: str) -> Path:
        return self.folder / camera / f"{self.name}_deep.{camera}.{frame:04d}.exr"

    def parts(self, picture: Picture, job: str = "") -> list[Any]:
        """Return the parts of a picture: one, or colour and data apart where colours lose by compression."""
        _check_size(picture)
        window, rows, columns = _window(picture, self.crop)
        matte = matte_metadata(list(picture.aovs.coverage)) if "crypto" in self.layers else {}
        color = crop(color_channels(picture, self.layers, self.target), rows, columns)
        data = crop(data_channels(picture, self.layers), rows, columns)
        name = picture.camera.name
        # Parts of a file have to agree on it.
        interop_id = self.target.interop_id if "rgba" in self.layers else NO_COLOR
        header = make_header(picture, interop_id, window, job)
        if self.compression in _LOSSY and color and data:
            # Lossless, whatever colours get: half a pixel of motion or of an id is no small error.
            return [
                _part(header, color, f"rgba.{name}", self.compression),
                _part(header | matte, data, f"data.{name}", "zips"),
            ]
        if not self.together:
            # A file of one view carries both, so that readers of either convention find it.
            header["multiView"] = [name]
        compression = "zips" if self.compression in _LOSSY and not color else self.compression
        # A file's only part goes without a name, which Blender would take for a layer's, and find no mattes.
        return [_part(header | matte, color | data, name if self.together else "", compression)]

    def _deep_part(self, picture: Picture, job: str) -> Any:
        assert picture.deep is not None
        window, rows, columns = _window(picture, self.crop)
        header = make_header(picture, self.target.interop_id, window, job)
        color, alpha = picture.output.color.numpy(), picture.output.alpha.numpy()
        flat = self.target.premultiplied(color, alpha)
        channels = deep_channels(picture.deep, flat, self.target, rows, columns)
        exr = openexr()
        header |= {"type": exr.deepscanline, "compression": exr.ZIPS_COMPRESSION}
        header["multiView"] = [picture.camera.name]
        return exr.Part(header, channels)


def _part(header: dict[str, Any], channels: dict[str, Any], name: str, compression: str) -> Any:
    exr = openexr()
    kind = getattr(exr, "NO_COMPRESSION" if compression == "none" else f"{compression.upper()}_COMPRESSION")
    return exr.Part(header | {"type": exr.scanlineimage, "compression": kind}, channels, name=name)


def write_parts(path: Path, parts: Sequence[Any]) -> None:
    """Write a file that appears when it is complete.

    Raises:
        StorageError: The disk does not take it.
    """
    with atomic_write(path) as draft:
        openexr().File(list(parts)).write(str(draft))
        if not is_complete(draft):
            raise StorageError(f"{path}: the disk did not take its end: free some room, or write elsewhere")


def _holds(path: Path, views: Sequence[tuple[str, str]]) -> bool:
    """Return whether a file can be read to its end and says that it shows these cameras for these jobs."""
    if not path.is_file():
        return False
    exr = openexr()
    try:
        with exr.File(str(path), header_only=True) as file:
            # Copies: a file empties its headers when it is closed.
            headers = [dict(part.header) for part in file.parts]
        if {(each.get("view"), each.get("dsar/job")) for each in headers} != set(views):
            return False
        with exr.File(str(path)) as file:
            # Parts that cannot be read to their end are left out.
            return len(file.parts) == len(headers)
    except (RuntimeError, ValueError, OSError):
        return False


def _check_size(picture: Picture) -> None:
    height, width = picture.output.alpha.shape
    camera, margin = picture.camera, 2 * picture.overscan
    if (width, height) != (camera.width + margin, camera.height + margin):
        raise ExportError(
            f"frame {picture.frame}: expected an image of {camera.width + margin}x{camera.height + margin} "
            f"from camera {camera.name}, found {width}x{height}: render with the camera that is passed"
        )


def _window(picture: Picture, cropped: bool) -> tuple[Window, slice, slice]:
    """Return which pixels are written: in the display window's coordinates, and as rows and columns."""
    height, width = picture.output.alpha.shape
    top, bottom, left, right = 0, height, 0, width
    if cropped:
        hit = picture.output.alpha.numpy() > 0
        if not hit.any():
            # A file has to have a pixel.
            top, bottom, left, right = 0, 1, 0, 1
        else:
            top, bottom = _extent(np.flatnonzero(hit.any(axis=1)))
            left, right = _extent(np.flatnonzero(hit.any(axis=0)))
    margin = picture.overscan
    window = left - margin, top - margin, right - 1 - margin, bottom - 1 - margin
    return window, slice(top, bottom), slice(left, right)


def _extent(places: np.ndarray) -> tuple[int, int]:
    """Return the first place, and the one after the last."""
    return int(places[0]), int(places[-1]) + 1
