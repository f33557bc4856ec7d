"""EXR sequences: which files a picture becomes, what is in each, and whether one is there already."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dsar.errors import ExportError
from dsar.types import Camera, Picture
from dsar_exporters.checks import check_name
from dsar_exporters.color import ColorTarget
from dsar_exporters.exr.channels import color_channels, crop, data_channels
from dsar_exporters.exr.cryptomatte import matte_metadata
from dsar_exporters.exr.deep import deep_channels
from dsar_exporters.exr.header import NO_COLOR, make_header
from dsar_exporters.exr.openexr import require_openexr
from dsar_exporters.exr.parts import holds_views, make_part, write_parts
from dsar_exporters.exr.windows import check_size, data_window

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
        require_openexr()

    @property
    def key(self) -> str:
        """All settings that files depend on, besides their place."""
        return repr((self.name, self.layers, self.target.key, self.compression, self.views, self.crop))

    @property
    def combines_cameras(self) -> bool:
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
        if self.combines_cameras and len(sizes) > 1:
            raise ExportError(
                f"--exr-views multipart: expected cameras of one size, found {sizes}: give one with --res"
            )

    def write(self, pictures: Sequence[Picture], job_hashes: Sequence[str]) -> list[Path]:
        """Write a frame's pictures and return the files, which appear when they are complete.

        Args:
            pictures: One a camera.
            job_hashes: For each the hash of all that its file depends on; see `is_complete`.
        """
        parts = [
            self.parts(picture, job_hash) for picture, job_hash in zip(pictures, job_hashes, strict=True)
        ]
        if self.combines_cameras:
            path = self._path(pictures[0].frame, None)
            write_parts(path, [part for picture_parts in parts for part in picture_parts])
            written = [path]
        else:
            written = [self._path(picture.frame, picture.camera.name) for picture in pictures]
            for path, picture_parts in zip(written, parts, strict=True):
                write_parts(path, picture_parts)
        for picture, job_hash in zip(pictures, job_hashes, strict=True):
            if picture.deep is not None:
                path = self._deep_path(picture.frame, picture.camera.name)
                write_parts(path, [self._deep_part(picture, job_hash)])
                written.append(path)
        return written

    def is_complete(self, frame: int, cameras: Sequence[str], job_hashes: Sequence[str], deep: bool) -> bool:
        """Return whether a frame's files are there, whole, and from these very jobs."""
        views = list(zip(cameras, job_hashes, strict=True))
        files = {self._path(frame, None): views} if self.combines_cameras else {}
        for view in views:
            if not self.combines_cameras:
                files[self._path(frame, view[0])] = [view]
            if deep:
                files[self._deep_path(frame, view[0])] = [view]
        return all(holds_views(path, expected) for path, expected in files.items())

    def _path(self, frame: int, camera: str | None) -> Path:
        if camera is None:
            return self.folder / f"{self.name}.{frame:04d}.exr"
        return exr_path(self.folder, name=self.name, camera=camera, frame=frame)

    def _deep_path(self, frame: int, camera: str) -> Path:
        return self.folder / camera / f"{self.name}_deep.{camera}.{frame:04d}.exr"

    def parts(self, picture: Picture, job_hash: str = "") -> list[Any]:
        """Return the parts of a picture: one, or colour and data apart where colours lose by compression."""
        check_size(picture)
        window, rows, columns = data_window(picture, self.crop)
        matte = matte_metadata(list(picture.aovs.coverage)) if "crypto" in self.layers else {}
        color = crop(color_channels(picture, self.layers, self.target), rows, columns)
        data = crop(data_channels(picture, self.layers), rows, columns)
        name = picture.camera.name
        # Parts of a file have to agree on it.
        interop_id = self.target.interop_id if "rgba" in self.layers else NO_COLOR
        header = make_header(picture, interop_id, window, job_hash)
        if self.compression in _LOSSY and color and data:
            # Lossless, whatever colours get: half a pixel of motion or of an id is no small error.
            return [
                make_part(header, color, f"rgba.{name}", self.compression),
                make_part(header | matte, data, f"data.{name}", "zips"),
            ]
        if not self.combines_cameras:
            # A file of one view carries both, so that readers of either convention find it.
            header["multiView"] = [name]
        compression = "zips" if self.compression in _LOSSY and not color else self.compression
        # A file's only part goes without a name, which Blender would take for a layer's, and find no mattes.
        return [make_part(header | matte, color | data, name if self.combines_cameras else "", compression)]

    def _deep_part(self, picture: Picture, job_hash: str) -> Any:
        assert picture.deep is not None
        window, rows, columns = data_window(picture, self.crop)
        header = make_header(picture, self.target.interop_id, window, job_hash)
        color, alpha = picture.output.color.numpy(), picture.output.alpha.numpy()
        flat = self.target.premultiplied(color, alpha)
        channels = deep_channels(picture.deep, flat, self.target, rows, columns)
        exr = require_openexr()
        header |= {"type": exr.deepscanline, "compression": exr.ZIPS_COMPRESSION}
        header["multiView"] = [picture.camera.name]
        return exr.Part(header, channels)
