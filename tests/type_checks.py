"""Shapes and types are checked at run time, but not in modules that their room calls many times a frame.

There the checks took as long again as the tests themselves; what goes in and comes out is checked at the
room's door: `dsar.network.model` and `session`, `dsar.avatar.avatar`.
"""

from collections.abc import Iterator
from pathlib import Path

from jaxtyping import install_import_hook

ROOT = Path(__file__).parents[1]
SOURCES = (ROOT / "dsar", ROOT / "exporters" / "dsar_exporters", ROOT / "render" / "dsar_render")
INNER = {
    *(f"dsar.network.{name}" for name in ("decoder", "encoder", "layers", "memory", "positions", "pyramid")),
    *(f"dsar.network.{name}" for name in ("readout", "ring", "state", "temporal")),
    *(f"dsar.avatar.{name}" for name in ("bilinear", "input_maps", "input_statistics")),
}


def checked_modules() -> Iterator[str]:
    """Yield the names of the modules that are checked; a package's name stands for all that is in it."""
    for folder in SOURCES:
        for path in sorted(folder.rglob("*.py")):
            name = ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__")
            if name not in INNER and not any(inner.startswith(f"{name}.") for inner in INNER):
                yield name


def install() -> None:
    """Check what is imported from now on."""
    install_import_hook(list(checked_modules()), "beartype.beartype")
