"""EXR sequences as other applications' libraries read them: OpenImageIO, and OpenEXR where it says so."""

from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import torch

from dsar.types import Camera, Picture, RenderOutput
from dsar_exporters import ExrSequence
from dsar_render.aovs import AOVS

PROVENANCE = {"checkpoint": "abc123", "motion": "turn", "dsar": "0.1"}
DEEP = dict.fromkeys("RGBA", "float") | {"Z": "float", "particleid": "uint"}
HALF = dict.fromkeys("RGBA", "half")
MATTES = {f"CryptoMaterial{rank:02d}.{name}": "float" for rank in range(3) for name in "RGBA"}
CHANNELS = {
    "rgba": HALF,
    "alpha": {"A": "half"},
    "Z": {"Z": "float", "front.Z": "float"},
    "N": {"N.X": "float", "N.Y": "float", "N.Z": "float"},
    "P": {"P.X": "float", "P.Y": "float", "P.Z": "float"},
    "motion": {"forward.u": "float", "forward.v": "float", "backward.u": "float", "backward.v": "float"},
    "id": {"id": "uint"},
    "crypto": MATTES,
}


def flat_picture(color: torch.Tensor, alpha: torch.Tensor, camera: Camera, **fields) -> Picture:
    """Return a picture of straight colours that are the same everywhere in it."""
    size = (camera.height, camera.width)
    output = RenderOutput(
        (color * alpha).expand(*size, 3), alpha.expand(size), torch.ones(size), torch.tensor(0)
    )
    return Picture(1001, camera, output, **fields)


def write(folder: Path, *pictures: Picture, layers=AOVS, **settings) -> list[Path]:
    jobs = [f"job of {picture.camera.name}" for picture in pictures]
    return ExrSequence(folder, layers=layers, **settings).write(pictures, jobs)


def parts_of(path: Path) -> list[oiio.ImageSpec]:
    file = oiio.ImageInput.open(str(path))
    assert file is not None, oiio.geterror()
    specs = []
    while file.seek_subimage(len(specs), 0):
        specs.append(file.spec().copy())
    file.close()
    return specs


def types_of(spec: oiio.ImageSpec) -> dict[str, str]:
    formats = spec.channelformats or (spec.format,) * spec.nchannels
    return {name: str(kind) for name, kind in zip(spec.channelnames, formats, strict=True)}


def channels_of(path: Path) -> dict[str, np.ndarray]:
    """Return all channels of all parts, each in its own type; of several parts as `part/channel`."""
    file, specs, found = oiio.ImageInput.open(str(path)), parts_of(path), {}
    for index, spec in enumerate(specs):
        prefix = f"{spec['oiio:subimagename']}/" if len(specs) > 1 else ""
        for place, (name, kind) in enumerate(types_of(spec).items()):
            pixels = file.read_image(index, 0, place, place + 1, oiio.TypeDesc(kind))
            assert pixels is not None, file.geterror()
            found[prefix + name] = pixels[..., 0]
    file.close()
    return found


def unprefixed(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.rpartition("/")[2]: values for name, values in channels.items()}


def rgba_of(path: Path) -> np.ndarray:
    found = unprefixed(channels_of(path))
    return np.stack([found[name] for name in "RGBA"], -1).astype(np.float32)


def header_of(path: Path, part: int = 0) -> dict:
    with OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.parts[part].header)


def bits(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values).tobytes()


def attributes(path: Path) -> list[tuple[str | None, object]]:
    """Return each part's `view` and `multiView`, in OpenEXR's words."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return [(part.header.get("view"), part.header.get("multiView")) for part in file.parts]
