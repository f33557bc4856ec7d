"""What a picture is made of, besides the frame and the camera."""

from dataclasses import dataclass

from dsar.errors import ConfigError
from dsar_render.aovs import AOVS


@dataclass(frozen=True)
class RenderSettings:
    """What a picture is made of, besides the frame and the camera."""

    aovs: tuple[str, ...] = ("rgba", "Z")
    """Output variables, some of `AOVS`, in the order in which they are listed."""
    deep: bool = False
    """Whether samples at their depths are wanted, too."""
    deep_max_samples: int = 32
    """Samples a pixel at most."""
    motion_samples: int = 1
    """Images that are averaged over the shutter's time."""
    shutter: tuple[float, float] = (0.0, 0.0)
    """When it opens and closes, in frames from the frame's own time, within -1 to 1."""
    overscan: int = 0
    """Pixels beyond each side of the image."""

    def __post_init__(self) -> None:
        """Check the settings against each other."""
        opens, closes = self.shutter
        unknown = [name for name in self.aovs if name not in AOVS]
        if unknown or not self.aovs:
            raise ConfigError(
                f"--aov: expected some of {', '.join(AOVS)}, found {', '.join(unknown) or 'none'}"
            )
        if not -1 <= opens <= closes <= 1:
            raise ConfigError(
                "--shutter: expected opening and closing times from -1 to 1 frames, found "
                f"{opens:g} {closes:g}"
            )
        if self.motion_samples < 1 or self.deep_max_samples < 1 or self.overscan < 0:
            raise ConfigError(
                "--motion-samples and --deep-max-samples start at 1, --overscan at 0; found "
                f"{self.motion_samples}, {self.deep_max_samples} and {self.overscan}"
            )
        if self.motion_samples > 1 and opens == closes:
            raise ConfigError(
                f"--motion-samples {self.motion_samples}: the shutter is never open; give it a time, such as "
                "--shutter -0.25 0.25"
            )
        if self.deep and self.motion_samples > 1:
            raise ConfigError(
                "--deep: a sample has one depth, and an open shutter would blur it; "
                "leave --motion-samples out"
            )
        if self.deep and any(self.times):
            raise ConfigError(
                f"--deep: samples are of the frame's own time, and --shutter {opens:g} {closes:g} takes the "
                f"image at {self.times[0]:g}; leave --shutter out"
            )

    @property
    def times(self) -> list[float]:
        """When the averaged images are taken, in frames from the frame's own time."""
        opens, closes = self.shutter
        step = (closes - opens) / self.motion_samples
        return [opens + (index + 0.5) * step for index in range(self.motion_samples)]

    @property
    def needs_neighbours(self) -> bool:
        """Whether the frames before and after are needed."""
        return "motion" in self.aovs or any(self.times)
