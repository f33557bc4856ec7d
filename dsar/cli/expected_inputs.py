"""What a picture depends on, in a flag: a farm's task refuses where its machine has something else."""

from collections.abc import Mapping

from dsar.errors import ConfigError

_WHAT = {
    "dsar": "dsar's version",
    "checkpoint": "the run's avatar",
    "model": "the run's settings (config.json)",
    "motion": "the motion",
    "cameras": "the cameras",
    "ocio": "the OCIO configuration, or tables and variables that it refers to",
}


def to_flag(inputs: Mapping[str, str]) -> str:
    """Return the value of --expect: `checkpoint=HASH,motion=HASH,...`."""
    return ",".join(f"{name}={value}" for name, value in inputs.items())


def check_inputs(expected: str, found: Mapping[str, str]) -> None:
    """Check that the inputs are those that a job was written for.

    Args:
        expected: As `to_flag` returned it there.
        found: What is here, by the same names.

    Raises:
        ConfigError: It names each that differs, or that is not known.
    """
    parts = [part.partition("=") for part in expected.split(",")]
    unknown = [name or "an empty part" for name, _, value in parts if name not in _WHAT or not value]
    if unknown:
        raise ConfigError(
            f"--expect: expected NAME=HASH of {', '.join(_WHAT)}, as --openjd writes it, found "
            f"{', '.join(unknown)}"
        )
    differing = [
        f"{_WHAT[name]} ({found.get(name, 'none')} instead of {value})"
        for name, _, value in parts
        if found.get(name) != value
    ]
    if differing:
        raise ConfigError(
            f"--expect: not the same here as where the job was written: {'; '.join(differing)}; bring this "
            "machine what the job was written with, or write the job anew"
        )
