"""`dsar render`."""

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dsar.cli.camera_selection import CameraSelection
from dsar.cli.drive_command import DriveCommand, DrivenAvatar
from dsar.cli.expected_inputs import check_inputs, to_flag
from dsar.config import EMBEDDED_CAPTURES
from dsar.console import track_progress
from dsar.errors import ConfigError
from dsar.geometry.camera_files import cameras_to_json
from dsar.geometry.camera_paths import CameraPath

if TYPE_CHECKING:
    from dsar_exporters import ColorTarget
    from dsar_render import RenderSettings, Shot
    from dsar_render.writers import PictureWriter

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class RenderFacts:
    """What was rendered; the fields are the keys of `dsar render --json`."""

    motion: str
    """Name of the motion."""
    images: int
    """Rendered now, over all cameras."""
    skipped: int
    """Images that were there already."""
    cameras: Sequence[str]
    """Names of the cameras."""


@dataclass(frozen=True)
class Render(DriveCommand):
    """Drive an avatar with a motion and render image sequences."""

    exr: Path | None = None
    """Folder of EXR sequences: DIR/<camera>/<name>.<camera>.%04d.exr."""
    png: Path | None = None
    """Folder of PNG sequences, display-referred with alpha."""
    mp4: Path | None = None
    """Video of the chosen cameras side by side, over white."""
    camera: str = "all"
    """Cameras by name or pattern, with commas (`cam0?,cam12`); `all`; or one made for the motion: `turntable`
    (goes with the person), `orbit` (stays), `dolly` (moves in)."""
    cameras: Path | None = None
    """JSON or USD file whose cameras take the place of the capture's."""
    res: tuple[int, int] | None = None
    """Width and height in pixels; default: the camera's own."""
    overscan: int = 0
    """EXR: pixels rendered beyond each side of the image."""
    crop: bool = False
    """EXR: keep only the pixels around the person (data window)."""
    aov: str = "rgba,Z"
    """EXR: output variables, with commas, of rgba, alpha, Z, N, P, motion, id, crypto."""
    deep: bool = False
    """EXR: also deep images, <name>_deep.<camera>.%04d.exr."""
    deep_max_samples: int = 32
    """Samples of a deep pixel at most."""
    colorspace: str = "lin_rec709_scene"
    """EXR: colour space (a name, alias or role of the OCIO configuration, such as ACEScg)."""
    ocio: str | None = None
    """OCIO configuration: a file, or a built-in `ocio://NAME`; default: $OCIO, else the built-in one."""
    exr_compression: Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"] = (
        "zips"
    )
    """Of colours; data channels are never compressed lossily."""
    exr_views: Literal["separate", "multipart"] = "separate"
    """A file for each camera, or all cameras as parts of one: DIR/<name>.%04d.exr."""
    motion_samples: int = 1
    """Images averaged while the shutter is open."""
    shutter: tuple[float, float] = (0.0, 0.0)
    """When the shutter opens and closes, in frames, e.g. -0.25 0.25."""
    jobs: int = 1
    """Processes that draw and write."""
    scheduler: str | None = None
    """Dask cluster that draws and writes instead: tcp://HOST:PORT."""
    skip_existing: bool = False
    """Leave frames alone whose files are there, whole, and from this very job."""
    openjd: Path | None = None
    """Render nothing; write an OpenJobDescription template that renders this in chunks on a farm."""
    chunk: int = 10
    """OpenJD: frames of a task."""
    expect: str | None = None
    """Written by --openjd: refuse where what the pictures depend on (NAME=HASH, with commas) differs here."""
    name: str = "avatar"
    """Name in the files."""

    def output_files(self) -> list[Path]:
        """Return the video and the farm's job."""
        return [path for path in (self.mp4, self.openjd) if path is not None]

    def output_folders(self) -> list[Path]:
        """Return the folders of image sequences; a farm's job writes none."""
        return [path for path in (self.exr, self.png) if path is not None and self.openjd is None]

    def describe_remains(self) -> str:
        """Return what is left."""
        if not self.output_folders():
            return "nothing was written"
        return "the images that were finished stay; the same command with --skip-existing goes on"

    def run(self) -> None:
        """Render every chosen camera and write every requested format."""
        from dsar_render import Shot

        if self.exr is None and self.png is None and self.mp4 is None:
            raise ConfigError("dsar render: nothing to write; give --exr DIR, --png DIR or --mp4 FILE")
        self.check_name(self.name)
        if self.res is not None and min(self.res) < 1:
            raise ConfigError(
                f"--res {self.res[0]} {self.res[1]}: expected width and height in pixels, at least 1 each"
            )
        wanted = self.requested_frames()
        settings = self.settings()
        writers = tuple(self.writers())
        driven = self.open()
        frames = wanted or list(driven.whole.frame_numbers)
        driven.roll_out(frames)  # names frames that are not in the motion
        selection = self.selection(driven)
        paths = selection.paths(frames)
        self.check_together(paths)
        if self.expect is not None:
            check_inputs(self.expect, self.inputs(selection))
        shot = Shot(tuple(paths), writers, settings, previews=self.mp4 is not None)
        if self.openjd is not None:
            self.write_template(self.openjd, selection, frames)
            return
        rendered = self.render(driven, shot, frames)
        facts = RenderFacts(
            motion=driven.motion.name,
            images=rendered * len(paths),
            skipped=(len(frames) - rendered) * len(paths),
            cameras=[path.name for path in paths],
        )
        self.write_json(dataclasses.asdict(facts))

    def render(self, driven: DrivenAvatar, shot: "Shot", frames: Sequence[int]) -> int:
        """Render what is not there yet; return how many frames that was."""
        from dsar_render import add_neighbours, render_shot, write_mp4

        facts = dict(driven.whole.provenance)
        # A video needs every frame.
        if self.skip_existing and self.mp4 is None:
            frames = [frame for frame in frames if not shot.is_complete(frame, facts)]
        if not frames:
            return 0
        every = driven.whole.frame_numbers
        rolled = add_neighbours(frames, every[0], every[-1]) if shot.settings.needs_neighbours else frames
        sequence = driven.roll_out(rolled)
        done = render_shot(shot, sequence, frames, jobs=self.jobs, scheduler=self.scheduler)
        progress = track_progress(done, len(frames), self.progress, "render")
        if self.mp4 is None:
            for _ in progress:
                pass
        else:
            write_mp4((image for _, image in progress if image is not None), self.mp4, fps=sequence.fps)
        return len(frames)

    def settings(self) -> "RenderSettings":
        """Return what a picture is made of."""
        from dsar_render import RenderSettings

        # PNG and MP4 need no more than colours.
        aovs = tuple(self.aov.split(",")) if self.exr is not None else ("rgba",)
        return RenderSettings(
            aovs=aovs,  # pyright: ignore[reportArgumentType]
            deep=self.deep and self.exr is not None,
            deep_max_samples=self.deep_max_samples,
            motion_samples=self.motion_samples,
            shutter=self.shutter,
            overscan=self.overscan,
        )

    def writers(self) -> "Iterator[PictureWriter]":
        """Yield what pictures become."""
        from dsar_exporters import ExrSequence
        from dsar_render import PngSequence

        if self.exr is not None:
            target = self.color_target()
            layers = tuple(self.aov.split(","))
            how = {"compression": self.exr_compression, "views": self.exr_views, "crop": self.crop}
            yield ExrSequence(self.exr.absolute(), self.name, layers, target, **how)
        if self.png is not None:
            yield PngSequence(self.png.absolute(), self.name)

    def color_target(self) -> "ColorTarget":
        """Return the colour space and its configuration, as any folder names it."""
        from dsar_exporters import ColorTarget, ocio_config

        config = ocio_config(self.ocio)
        absolute = config if config.startswith("ocio://") else str(Path(config).absolute())
        return ColorTarget(self.colorspace, absolute)

    def selection(self, driven: DrivenAvatar) -> CameraSelection:
        """Return which cameras are chosen."""
        return CameraSelection(driven, tuple(self.camera.split(",")), self.cameras, self.res)

    def check_together(self, paths: Sequence[CameraPath]) -> None:
        """Check what the chosen cameras have to have in common."""
        views = [path.cameras[0] for path in paths]
        for writer in self.writers():
            writer.check(views)
        if self.mp4 is not None and len({view.height for view in views}) > 1:
            raise ConfigError(
                "--mp4: expected cameras of one height, found several: give one size with --res W H"
            )

    def inputs(self, selection: CameraSelection) -> dict[str, str]:
        """Return hashes of all that pictures depend on besides the command itself, by what they are of."""
        driven = selection.driven
        hashes = {"dsar": version("dsar-avatar"), **driven.inputs}
        # Not at the frames of a task alone: every task of a job has the same hash.
        cameras = selection.read_chosen(driven.whole.frame_numbers)
        if cameras:
            hashes["cameras"] = sha256(cameras_to_json(cameras).encode()).hexdigest()[:16]
        if self.exr is not None:
            hashes["ocio"] = sha256(self.color_target().contents.encode()).hexdigest()[:16]
        return hashes

    def write_template(self, path: Path, selection: CameraSelection, frames: Sequence[int]) -> None:
        """Write the farm's job."""
        from dsar.atomic_files import write_text_atomically
        from dsar.training.checkpoint import Run, read_config
        from dsar_render import openjd_template

        if self.mp4 is not None:
            raise ConfigError("--mp4: a farm's task has some frames, a video all of them; leave --mp4 out")
        run = Run(self.chosen_run())
        keeps_scene = run.scene.exists() or read_config(run).capture in EMBEDDED_CAPTURES
        if not keeps_scene and not (self.motion_file() and self.cameras):
            LOGGER.warning(
                "Run %s is older and keeps no cameras and motions: the farm's machines need its capture",
                run.folder,
            )
        command = ["dsar", "render", *self.arguments(), "--expect", to_flag(self.inputs(selection))]
        write_text_atomically(path, openjd_template(self.name, command, frames, chunk=self.chunk))

    def arguments(self) -> list[str]:
        """Return the arguments that make this command, but for which frames, with absolute paths."""
        file = self.motion_file()
        found = [str(self.chosen_run().absolute())]
        found += ["--motion", self.motion if file is None else str(file.absolute())]
        if self.exr is not None:
            # Also the built-in one: another machine's $OCIO may name another.
            found += ["--ocio", self.color_target().config]
        left_out = ("run_folder", "motion", "frames", "ocio", "openjd", "chunk", "expect", "json", "progress")
        left_out += ("skip_existing",)
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if each.name in left_out or value == each.default:
                continue
            flag = f"--{each.name.replace('_', '-')}"
            found += [flag] if value is True else [flag, *map(_absolute, _listed(value))]
        # A task that is given out again goes on where it was cut off.
        return [*found, "--skip-existing"]


def _listed(value: object) -> Sequence[object]:
    return value if isinstance(value, tuple) else (value,)


def _absolute(value: object) -> str:
    return str(value.absolute()) if isinstance(value, Path) else str(value)
