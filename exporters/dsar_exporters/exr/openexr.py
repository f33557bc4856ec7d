"""The OpenEXR module, imported when a file is written or read."""

from types import ModuleType

from dsar_exporters.optional import require


def require_openexr() -> ModuleType:
    """Return the OpenEXR module.

    Raises:
        MissingDependencyError: It is not installed.
    """
    return require("OpenEXR", feature="EXR", package="OpenEXR", extra="exr")
