"""Which cameras `dsar render` draws: of the capture, of a file, or made for the motion."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

from dsar.cli.drive_command import DrivenAvatar
from dsar.errors import CheckpointError, ConfigError
from dsar.geometry.camera_files import list_cameras_json, read_cameras_json
from dsar.geometry.camera_paths import DOLLY, ORBIT, TURNTABLE, CameraPath, dolly, orbit, turntable

_MADE_FOR_MOTION = {TURNTABLE: turntable, ORBIT: orbit, DOLLY: dolly}


@dataclass(frozen=True)
class CameraSelection:
    """What --camera, --cameras and --res choose for a driven avatar."""

    driven: DrivenAvatar
    patterns: tuple[str, ...]
    """The parts of --camera: names, patterns, or `all`."""
    file: Path | None
    """Cameras of a JSON or USD file in place of the capture's."""
    resolution: tuple[int, int] | None
    """Width and height in pixels; None: each camera's own."""

    @cached_property
    def names(self) -> list[str]:
        """The names of the cameras to choose from: the capture's, or the file's."""
        if self.file is None:
            try:
                return [camera.name for camera in self.driven.cameras]
            except CheckpointError:
                # Those made for the motion need none of the capture's but for their size.
                if self.resolution is None or not set(self.patterns) <= _MADE_FOR_MOTION.keys():
                    raise
                return []
        if _is_usd(self.file):
            from dsar_exporters import list_usd_cameras

            return list_usd_cameras(self.file)
        return list_cameras_json(self.file)

    def read_chosen(self, frames: Sequence[int]) -> list[CameraPath]:
        """Return the chosen cameras of the capture or the file alone: others may be such as nobody draws.

        Args:
            frames: At which a USD camera that moves is keyed.
        """
        chosen = {name for name in self.names if any(_matches(part, name) for part in self.patterns)}
        if self.resolution is None and any(map(self._is_made, self.patterns)):
            # Cameras that are made for the motion have the first one's size.
            chosen.add(self.names[0])
        if not chosen:
            return []
        if self.file is None:
            return [CameraPath((camera,)) for camera in self.driven.cameras if camera.name in chosen]
        return self._read_file(self.file, frames, chosen)

    def _read_file(self, file: Path, frames: Sequence[int], chosen: Collection[str]) -> list[CameraPath]:
        fps = self.driven.delivered.fps
        if _is_usd(file):
            from dsar_exporters import read_usd_cameras

            return read_usd_cameras(file, frames=frames, resolution=self.resolution, fps=fps, chosen=chosen)
        return read_cameras_json(file, fps=fps, chosen=chosen)

    def paths(self, frames: Sequence[int]) -> list[CameraPath]:
        """Return the cameras to render, each once, in the order of --camera and at the resolution.

        Raises:
            ConfigError: A part of --camera chooses none.
        """
        filed = self.read_chosen(frames)
        paths: list[CameraPath] = []
        for part in self.patterns:
            if self._is_made(part):
                size = self.resolution or (filed[0].cameras[0].width, filed[0].cameras[0].height)
                paths.append(self._make(part, size))
                continue
            chosen = [path for path in filed if _matches(part, path.name)]
            if not chosen:
                made, known = ", ".join(_MADE_FOR_MOTION), ", ".join(self.names)
                raise ConfigError(f"--camera {part}: expected all, {made}, or some of {known}")
            earlier = {path.name for path in paths}
            paths += [path for path in chosen if path.name not in earlier]
        return [path.resized(*self.resolution) if self.resolution else path for path in paths]

    def _is_made(self, part: str) -> bool:
        """Return whether a part of --camera names a camera that is made for the motion."""
        return part in _MADE_FOR_MOTION and part not in self.names

    def _make(self, name: str, size: tuple[int, int]) -> CameraPath:
        whole, (width, height) = self.driven.whole, size
        assert whole.binding is not None, "an avatar's rollout has a body"
        make = _MADE_FOR_MOTION[name]
        return make(whole.binding, whole.frame_numbers, whole.fps, width=width, height=height)


def _matches(part: str, name: str) -> bool:
    """Return whether a part of --camera chooses a camera."""
    return fnmatchcase(name, "*" if part == "all" else part)


def _is_usd(path: Path) -> bool:
    return path.suffix.lower() in (".usd", ".usda", ".usdc", ".usdz")
