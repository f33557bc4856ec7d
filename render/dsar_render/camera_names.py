"""Names of cameras, which become folders and parts of file names."""

from collections.abc import Sequence

from dsar.errors import ConfigError


def check_camera_names(names: Sequence[str]) -> None:
    """Check that there are cameras, each with a name of its own.

    Raises:
        ConfigError: There are none, or two share a name and would overwrite each other's files.
    """
    if not names:
        raise ConfigError("render: expected at least one camera, found none: name one or pass all")
    if doubled := {name for name in names if names.count(name) > 1}:
        raise ConfigError(
            f"render: expected distinct camera names, found {sorted(doubled)} twice: rename one"
        )
