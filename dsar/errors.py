"""The errors a user can meet.

DsarError                       every message says what, where, expected, found, what to do
├── ConfigError      (ValueError)   a setting or flag
├── CaptureError     (ValueError)   a capture folder, its images, cameras or masks
├── MotionError      (ValueError)   a motion file
├── BodyError        (ValueError)   a body-model file
├── CheckpointError  (ValueError)   a run folder or its checkpoint
├── ExportError      (ValueError)   something that cannot be written as asked
├── RasterError      (ValueError)   Gaussians that cannot be drawn
├── StorageError     (OSError)      a disk or folder that does not take or give a file
├── RenderError      (RuntimeError) frames could not be rendered
├── TrainingError    (ArithmeticError) training stopped: a value is not finite, or a worker died
└── MissingDependencyError (ImportError) an optional package is not installed
"""


class DsarError(Exception):
    """Base of all errors that the command line turns into one line and exit code 2."""


class ConfigError(DsarError, ValueError):
    """A setting or a flag is not usable."""


class CaptureError(DsarError, ValueError):
    """A capture is incomplete or malformed."""


class MotionError(DsarError, ValueError):
    """A motion file is incomplete or malformed."""


class BodyError(DsarError, ValueError):
    """A body-model file is incomplete or malformed."""


class CheckpointError(DsarError, ValueError):
    """A run folder does not hold what was asked of it."""


class ExportError(DsarError, ValueError):
    """Something cannot be written as asked."""


class RasterError(DsarError, ValueError):
    """Gaussians cannot be drawn."""


class StorageError(DsarError, OSError):
    """The system does not take or give a file: no room, no permission, no folder, no disk."""


class RenderError(DsarError, RuntimeError):
    """Frames could not be rendered: workers or a cluster failed."""


class TrainingError(DsarError, ArithmeticError):
    """Training met a value that is not finite, or lost a worker."""


class MissingDependencyError(DsarError, ImportError):
    """An optional package is not installed."""

    def __init__(self, feature: str, package: str, extra: str) -> None:
        """Name the feature, the package it lacks and the extra that brings it."""
        super().__init__(f"{feature} needs {package}: pip install 'dsar-avatar[{extra}]'")
        self._named = feature, package, extra

    def __reduce__(self) -> tuple[type["MissingDependencyError"], tuple[str, str, str]]:
        """Come out of another process as what it is."""
        return type(self), self._named
