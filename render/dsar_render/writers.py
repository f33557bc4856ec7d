"""What a format of pictures must be able to do: `PngSequence` here, `ExrSequence` in exporters."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from dsar.types import Camera, Picture


@runtime_checkable
class PictureWriter(Protocol):
    """A format, and where its files go."""

    @property
    def key(self) -> str:
        """All settings that files depend on, besides their place."""
        ...

    @property
    def combines_cameras(self) -> bool:
        """Whether all cameras of a frame go into one file."""
        ...

    def check(self, cameras: Sequence[Camera]) -> None:
        """Raise a DsarError where cameras cannot be written together."""
        ...

    def write(self, pictures: Sequence[Picture], job_hashes: Sequence[str]) -> Any:
        """Write a frame's pictures, all of them if `combines_cameras`, each with the hash of its job."""
        ...

    def is_complete(self, frame: int, cameras: Sequence[str], job_hashes: Sequence[str], deep: bool) -> bool:
        """Return whether a frame's files are there, whole, and from these very jobs."""
        ...
