"""The records that cross room borders, each with one frame, one unit and one convention.

World: metres, Y up, right-handed. Cameras: OpenCV (x right, y down, z forward).
Pixel (0, 0) has its centre at (0.5, 0.5). Quaternions: unit, wxyz. Colours: display-referred sRGB.
`T_dst_src` maps points from frame `src` to frame `dst`. See docs/conventions.md.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """A set of 3D Gaussians with physical values, never log-scales or logits."""

    means: Float[Tensor, "n 3"]
    """Centres in world metres."""
    rotations: Float[Tensor, "n 4"]
    """Unit quaternions wxyz, Gaussian axes to world."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the Gaussian's axes, metres, > 0."""
    opacities: Float[Tensor, " n"]
    """Peak opacity in [0, 1]."""
    harmonics: Float[Tensor, "n k 3"]
    """Spherical-harmonic coefficients, DC first; colour = basis · harmonics + 0.5, clamped at 0."""

    def __post_init__(self) -> None:
        """Check that all fields describe the same number of Gaussians."""
        counts = {f.name: len(getattr(self, f.name)) for f in dataclasses.fields(self)}
        if len(set(counts.values())) != 1:
            raise ValueError(f"Gaussians fields disagree in length: {counts}")

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means)

    def map(self, function: Callable[[Tensor], Tensor]) -> "Gaussians":
        """Apply a function (a cast, a device move, a selection) to every field."""
        values = {f.name: function(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return dataclasses.replace(self, **values)

    def detach(self) -> "Gaussians":
        """Return the same values cut from the autograd graph."""
        return self.map(Tensor.detach)


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera in the OpenCV convention."""

    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels; the top-left corner of the image is (0, 0), not its first pixel centre."""
    T_camera_world: Float[Tensor, "4 4"]
    """Rigid transform of world points to the camera (x right, y down, z forward)."""
    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    name: str
    """A valid USD identifier; also the folder, view and label name in every export."""

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The camera's position in world metres."""
        rotation, translation = self.T_camera_world[:3, :3], self.T_camera_world[:3, 3]
        return -rotation.T @ translation

    def resized(self, width: int, height: int) -> "Camera":
        """Return the same view sampled at another resolution."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]])
        return dataclasses.replace(self, K=self.K * scale.to(self.K), width=width, height=height)

    def cropped(self, x: int, y: int, width: int, height: int) -> "Camera":
        """Return the view through the pixel rectangle whose top-left corner is (x, y)."""
        shift = torch.tensor([[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, 0.0]])
        return dataclasses.replace(self, K=self.K - shift.to(self.K), width=width, height=height)


@dataclass(frozen=True)
class Pose:
    """One instant of a motion: joint rotations and root translation of an SMPL-X skeleton."""

    rotations: Float[Tensor, "j 3"]
    """Axis-angle of each joint relative to its parent, radians; joint 0 (pelvis) relative to the world."""
    translation: Float[Tensor, "3"]
    """SMPL-X `transl`: added after posing, world metres."""


@dataclass(frozen=True)
class Motion:
    """A sequence of poses at a fixed rate, in the Y-up world."""

    rotations: Float[Tensor, "f j 3"]
    """Axis-angle per frame and joint, radians (see `Pose`)."""
    translations: Float[Tensor, "f 3"]
    """SMPL-X `transl` per frame, world metres."""
    fps: float
    """Frames per second."""
    name: str = "motion"
    """Label of the sequence."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.rotations)

    def __getitem__(self, index: int) -> Pose:
        """Return the pose of one frame."""
        return Pose(self.rotations[index], self.translations[index])

    def slice(self, start: int, stop: int) -> "Motion":
        """Return frames start..stop-1 as a motion of their own."""
        return dataclasses.replace(
            self, rotations=self.rotations[start:stop], translations=self.translations[start:stop]
        )


@dataclass(frozen=True)
class Body:
    """One person's body in the rest T-pose: Y up, facing +Z, left hand at +X, metres.

    The origin is the file's own (near the pelvis), so the feet are below y = 0.
    """

    vertices: Float[Tensor, "v 3"]
    """Shaped rest vertices."""
    faces: Int[Tensor, "t 3"]
    """Triangles as vertex indices, counter-clockwise seen from outside."""
    joints: Float[Tensor, "j 3"]
    """Shaped rest joints in SMPL-X's published order."""
    parents: tuple[int, ...]
    """Parent of each joint, always before its child; -1 at the pelvis."""
    weights: Float[Tensor, "v j"]
    """Skinning weights; every row sums to 1."""
    uv: Float[Tensor, "u 2"]
    """Texture coordinates in [0, 1], origin at the bottom left."""
    uv_faces: Int[Tensor, "t 3"]
    """The same triangles as indices into `uv`."""

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Body":
        """Return the body on another device, or with its real-valued fields in another precision."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        moved = {
            name: value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            for name, value in fields.items()
            if isinstance(value, Tensor)
        }
        return dataclasses.replace(self, **moved)


@dataclass(frozen=True)
class Contributors:
    """Which Gaussians made every pixel of an image: as many as blended there, pixel after pixel, row by row.

    Any other image is a sum over them: that of `weights * values[ids]` for values of the Gaussians.
    """

    counts: Int[Tensor, "h w"]
    """How many Gaussians each pixel has."""
    ids: Int[Tensor, " m"]
    """Their indices, front to back."""
    weights: Float[Tensor, " m"]
    """Their shares of the pixel: alpha times the transmittance of all in front; they sum to its alpha."""


@dataclass(frozen=True)
class RenderOutput:
    """What the rasteriser makes of one view."""

    color: Float[Tensor, "h w 3"]
    """Display-referred sRGB, premultiplied by alpha; over the background if one was given."""
    alpha: Float[Tensor, "h w"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "h w"]
    """Expected camera-space z in metres, sum(w z) / sum(w); 0 where nothing was hit."""
    culled: Int[Tensor, ""]
    """How many Gaussians were left out: not valid, too near, too faint, or without a pixel in the image."""
    median_depth: Float[Tensor, "h w"] | None = None
    """On request: z of the Gaussian with which transmittance falls to a half, else of the last one, metres; 0
    where nothing was hit. No gradient."""
    first_hit_depth: Float[Tensor, "h w"] | None = None
    """On request: z of the foremost Gaussian, metres; 0 where nothing was hit. No gradient."""
    largest_weight_id: Int[Tensor, "h w"] | None = None
    """On request: index of the Gaussian with the largest share, the foremost of equals; -1 where nothing was
    hit."""
    contributors: Contributors | None = None
    """On request; no gradient."""


@dataclass(frozen=True)
class Aovs:
    """What a compositor wants to know of each pixel besides its colour; None or empty where not asked for."""

    normals: Float[Tensor, "h w 3"] | None = None
    """Unit, world, towards the camera: the Gaussians' thinnest axes, blended; 0 where nothing was hit."""
    positions: Float[Tensor, "h w 3"] | None = None
    """World point, metres, at the pixel's centre and expected depth; 0 where nothing was hit."""
    forward: Float[Tensor, "h w 2"] | None = None
    """Pixels, x right and y down, that what is seen moves until the next frame; 0 where nothing was hit, and
    at a motion's last frame."""
    backward: Float[Tensor, "h w 2"] | None = None
    """Pixels, x right and y down, from where what is seen is to where it was a frame before, likewise."""
    coverage: Mapping[str, Float[Tensor, "h w"]] = field(default_factory=dict)
    """By label, such as `left_arm` or `garment`: its share of the pixel's alpha; they sum to it."""


@dataclass(frozen=True)
class DeepSamples:
    """The Gaussians of every pixel as samples at a depth, pixel after pixel, row by row, front to back."""

    counts: Int[Tensor, "h w"]
    """How many samples each pixel has."""
    colors: Float[Tensor, "m 3"]
    """Display-referred sRGB, not premultiplied."""
    alphas: Float[Tensor, " m"]
    """Of the sample alone, whatever lies in front of it."""
    depths: Float[Tensor, " m"]
    """Camera-space z, metres; never decreases within a pixel."""
    ids: Int[Tensor, " m"]
    """Index of the Gaussian, of the heaviest where several became one sample."""


@dataclass(frozen=True)
class GuardedFrame:
    """What guards found in one frame, and what they did about it."""

    exceeded: Mapping[str, float]
    """By a guard's name (`dsar.avatar.guards.Guard`) how many times training's largest there was; infinite
    where there was no number, and for a cut, which has no measure."""
    held: float = 0.0
    """Share of the offsets that is held from the frame before, in [0, 1): while it is above 0, what is shown
    is not what the network says."""

    def merged(self, other: "GuardedFrame") -> "GuardedFrame":
        """Return the worse of two frames, for a time between them."""
        names = self.exceeded.keys() | other.exceeded.keys()
        worst = {name: max(self.exceeded.get(name, 0.0), other.exceeded.get(name, 0.0)) for name in names}
        return GuardedFrame(dict(sorted(worst.items())), max(self.held, other.held))

    def describe(self) -> str:
        """Return it as one word for each guard, for the headers of files: `size=2.31 held=0.83`."""
        words = [f"{name}={value:.3g}" for name, value in self.exceeded.items()]
        return " ".join([*words, *([f"held={self.held:.3g}"] if self.held else [])])


@dataclass(frozen=True)
class Picture:
    """One camera's image of one frame, with all that a file of it says."""

    frame: int
    """Frame number."""
    camera: Camera
    """The view that is delivered; the image may reach beyond it (`overscan`)."""
    output: RenderOutput
    """Without a background. Colours and alpha over the shutter's time, the rest at the frame itself."""
    aovs: Aovs = field(default_factory=Aovs)
    """At the frame itself, coverage over the shutter's time."""
    deep: DeepSamples | None = None
    """On request."""
    overscan: int = 0
    """Pixels by which the image is larger than the camera's on each of its four sides."""
    shutter: tuple[float, float] = (0.0, 0.0)
    """When the shutter opens and closes, in frames from the frame's own time."""
    fps: float = 24.0
    """Frames per second of the frame numbers."""
    guarded: GuardedFrame | None = None
    """What guards found in the frame, if anything."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Where the image comes from; written into every file."""


@dataclass(frozen=True)
class Binding:
    """Rest positions, skin weights and joint transforms that bind Gaussians to the body in any program."""

    body: Body
    """The body at rest."""
    joint_names: tuple[str, ...]
    """Names of its joints."""
    points: Float[Tensor, "n 3"]
    """Rest position of each Gaussian's texel, metres: without what the network adds."""
    weights: Float[Tensor, "n j"]
    """Skin weights of each Gaussian; rows sum to 1."""
    uv: Float[Tensor, "n 2"]
    """Place of each Gaussian on the body's texture, origin at the bottom left; charts of garments lie
    below it, at v < 0."""
    T_world_rest: Float[Tensor, "f j 4 4"]
    """By frame of the sequence: where each joint carries points of the rest pose."""


@dataclass(frozen=True)
class GaussianSequence:
    """A rollout: a fixed set of Gaussians over time, made frame by frame as it is iterated."""

    frame_numbers: Sequence[int]
    """Frame numbers in the order they are produced (a film starts at 1001)."""
    fps: float
    """Frames per second of the frame numbers."""
    num_gaussians: int
    """The same in every frame; index i is the same Gaussian throughout."""
    produce: Callable[[], Iterator[Gaussians]] = field(repr=False)
    """Starts a fresh pass and yields one Gaussians per frame number."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Where the frames come from: checkpoint hash, motion, version. Written into every file."""
    binding: Binding | None = field(default=None, repr=False)
    """The body that carries the Gaussians, if there is one."""
    guarded: Mapping[int, GuardedFrame] = field(default_factory=dict, repr=False)
    """By frame number what guards found; filled as the frames of a pass are produced, and no others."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frame_numbers)

    def in_main_memory(self) -> "GaussianSequence":
        """Return the same frames in main memory, where files and images are made of them."""
        return dataclasses.replace(
            self, produce=lambda: (gaussians.map(Tensor.cpu) for gaussians in self.produce())
        )

    def __iter__(self) -> Iterator[tuple[int, Gaussians]]:
        """Yield (frame number, Gaussians); every call is a new pass from the first frame."""
        return zip(self.frame_numbers, self.produce(), strict=True)


@runtime_checkable
class Capture(Protocol):
    """Multi-view video of one dressed person, as every reader presents it."""

    @property
    def name(self) -> str:
        """Label of the capture."""
        ...

    @property
    def cameras(self) -> Sequence[Camera]:
        """Calibrated cameras, the same for every frame."""
        ...

    @property
    def motions(self) -> Mapping[str, Motion]:
        """Body motion of each sequence, by sequence name."""
        ...

    @property
    def splits(self) -> Mapping[str, Sequence[str]]:
        """Sequence names of `train` and `test`, and of labelled subsets such as `nd` and `fd`."""
        ...

    def cameras_with_image(self, sequence: str, frame: int) -> Sequence[int]:
        """Return the cameras that have an image of a frame with its mask, by index."""
        ...

    def image(self, sequence: str, frame: int, camera: int) -> UInt8[np.ndarray, "h w 4"]:
        """Return one image: straight (not premultiplied) sRGB and the mask as alpha."""
        ...

    def garment_mask(self, sequence: str, frame: int, camera: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where an image shows loose garments, by the capture's own labels; None without any."""
        ...
