"""The sidecar of an export: what the files are, for people and pipelines that cannot open them."""

import dataclasses
import importlib.metadata
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fileseq.frameset import FrameSet

from dsar.atomic_files import atomic_write
from dsar.types import GaussianSequence, GuardedFrame

_PACKAGES = ("dsar-avatar", "torch", "usd-core", "plyfile", "gsply", "fourdgs")
_IDS = "index 0 to gaussians - 1: the same Gaussian in every frame and every format that keeps order"


@dataclass(frozen=True)
class FrameRange:
    """The frames of an export."""

    range: str
    """As fileseq writes it."""
    count: int
    first: int
    last: int
    fps: float

    @classmethod
    def of_sequence(cls, sequence: GaussianSequence) -> "FrameRange":
        """Return the frames of a sequence."""
        numbers = list(sequence.frame_numbers)
        return cls(str(FrameSet(numbers)), len(numbers), numbers[0], numbers[-1], sequence.fps)


@dataclass(frozen=True)
class Manifest:
    """What `<name>.manifest.json` says, in the order of its keys."""

    frames: FrameRange
    gaussians: int
    ids: str = dataclasses.field(
        default=_IDS,
        init=False,
    )
    units: str = dataclasses.field(default="metres", init=False)
    up_axis: str = dataclasses.field(default="Y", init=False)
    color_space: str = dataclasses.field(default="srgb_rec709_display", init=False)
    half: bool | None
    """Whether splats are in 16 bits; None where the format knows no such choice, and then it has no key."""
    provenance: Mapping[str, str]
    versions: Mapping[str, str]
    """Of the packages that had a hand in it."""
    guarded: Mapping[int, Mapping[str, Any]]
    """By frame number what guards found there and did: by their names how many times training's largest there
    was (null: no number), and the share of the offsets that is `held` from the frame before."""
    files: Sequence[str]
    """As seen from the manifest's own folder."""

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {key: value for key, value in dataclasses.asdict(self).items() if value is not None}


def manifest_path(path: Path) -> Path:
    """Return the manifest of a file or folder: `<name>.manifest.json` beside it."""
    # The working folder has a name, too.
    path = path.absolute()
    return path.with_name(f"{path.name}.manifest.json")


def write_manifest(
    path: Path, sequence: GaussianSequence, files: Sequence[Path], *, half: bool | None = None
) -> Path:
    """Write the manifest of a file or folder and return its path.

    Args:
        path: The file or folder; a manifest that is there is replaced.
        sequence: What was written.
        files: Its files.
        half: Whether splats are in 16 bits, where the format has the choice.

    Raises:
        StorageError: The system does not take it.
    """
    folder = path.absolute().parent
    manifest = Manifest(
        frames=FrameRange.of_sequence(sequence),
        gaussians=sequence.num_gaussians,
        half=half,
        provenance=dict(sequence.provenance),
        versions=_versions(),
        guarded={number: _describe_guarded(frame) for number, frame in sorted(sequence.guarded.items())},
        files=[file.absolute().relative_to(folder).as_posix() for file in files],
    )
    target = manifest_path(path)
    with atomic_write(target) as draft:
        draft.write_text(json.dumps(manifest.to_json(), indent=2) + "\n")
    return target


def _describe_guarded(frame: GuardedFrame) -> dict[str, Any]:
    """Return what guards found in a frame, in numbers that JSON has."""
    exceeded = {name: value if math.isfinite(value) else None for name, value in frame.exceeded.items()}
    return {"exceeded": exceeded, "held": frame.held}


def _versions() -> dict[str, str]:
    """Return the versions of those packages that are installed."""
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
