"""The hash by which a file is recognised as the one that a job would write."""

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping
from functools import cache

from dsar.geometry.camera_paths import CameraPath
from dsar_render.settings import RenderSettings


def hash_job(
    frame: int, path: CameraPath, settings: RenderSettings, provenance: Mapping[str, str], writer: str
) -> str:
    """Return a hash of all that a picture's file depends on: equal where the bytes are equal.

    Args:
        frame: Frame number.
        path: The camera.
        settings: What is rendered.
        provenance: Where the Gaussians come from, to the checkpoint's and the motion's own hashes.
        writer: The settings of the file's writer, its `key`.
    """
    cameras = [path.at(frame + step) for step in (-1, 0, 1)]
    facts = {
        "frame": frame,
        "cameras": [[c.name, c.width, c.height, c.K.tolist(), c.T_camera_world.tolist()] for c in cameras],
        "settings": repr(settings),
        "provenance": dict(sorted(provenance.items())),
        "writer": writer,
        "version": _version(),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]


@cache
def _version() -> str:
    return importlib.metadata.version("dsar-avatar")
