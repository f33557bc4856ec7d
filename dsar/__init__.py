"""DSAR: Gaussian avatars whose clothes have memory.

Everything is imported on first use: `import dsar` alone is cheap.
"""

import os
from importlib import import_module
from typing import Any

# Idle OpenMP threads that spin take the cores from the rasteriser's; torch reads this at its first import.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_PUBLIC = {
    "open_capture": "dsar.data.captures.formats",
    "train": "dsar.training.loop",
    "load": "dsar.training.checkpoint",
    "roll_out": "dsar.avatar.rollout",
    "rasterize": "dsar.raster",
    "rasterize_views": "dsar.raster",
}


def __getattr__(name: str) -> Any:
    """Import a public function when it is first asked for."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'dsar' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """List the public functions."""
    return sorted(_PUBLIC)
