"""Farm jobs as Open Job Description templates, which `openjd run` and AWS Deadline Cloud take.

Specification: https://github.com/OpenJobDescription/openjd-specifications/wiki/2023-09-Template-Schemas
"""

import json
from collections.abc import Sequence
from typing import Any

from fileseq import framesToFrameRange

from dsar.errors import ConfigError

_MAX_VALUES = 1024
"""Values that a task parameter may have (§3.4.1.3)."""

_MAX_LETTERS = 1024
"""Letters that one of them may have."""

_NOTICE_S = 120
"""Seconds from SIGTERM, upon which our commands finish the images in hand, to SIGKILL."""


def openjd_template(name: str, command: Sequence[str], frames: Sequence[int], *, chunk: int) -> str:
    """Return a job template (2023-09, JSON) whose tasks run a command over chunks of frames.

    Each task runs `command --frames RANGE --progress plain`, RANGE being such as `1001-1010` or
    `1001-1009x2`; a code other than 0 fails it. Canceling sends SIGTERM first. The farm may run another
    program than `command[0]` through the job parameter `Program`. A task's working folder is one that the
    farm makes, so paths in the command should be absolute.

    Args:
        name: The job's name.
        command: Program and arguments, without `--frames` and `--progress`.
        frames: Frame numbers, in the order in which they are cut into chunks.
        chunk: Frames per task; the last task may have fewer.

    Raises:
        ConfigError: There are no frames, or the specification does not allow the template.
    """
    if chunk < 1:
        raise ConfigError(f"openjd: expected at least one frame per task, found {chunk}")
    if not frames:
        raise ConfigError("openjd: expected at least one frame, found none: widen the frame range")
    for text in (name, *command):
        if "{{" in text:
            raise ConfigError(
                f"openjd: {text!r}: '{{{{' begins a variable of the template and cannot be written "
                "otherwise: take other names"
            )
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "name": name,
        "parameterDefinitions": [
            {
                "name": "Program",
                "type": "STRING",
                "default": command[0],
                "description": "The dsar command on the farm's machines.",
            }
        ],
        "steps": [_step(command[1:], _ranges(frames, chunk))],
    }
    return json.dumps(template, indent=2) + "\n"


def _step(arguments: Sequence[str], ranges: list[str]) -> dict[str, Any]:
    run = {
        "command": "{{Param.Program}}",
        "args": [*arguments, "--frames", "{{Task.Param.Frames}}", "--progress", "plain"],
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": _NOTICE_S},
    }
    # Text, because ranges of numbers give each frame a task here, and put the step after a colon.
    parameter = {"name": "Frames", "type": "STRING", "range": ranges}
    return {
        "name": "Render",
        "parameterSpace": {"taskParameterDefinitions": [parameter]},
        "script": {"actions": {"onRun": run}},
    }


def _ranges(frames: Sequence[int], chunk: int) -> list[str]:
    """Return the frames of each task, as fileseq and `--frames` write them."""
    chunks = [frames[start : start + chunk] for start in range(0, len(frames), chunk)]
    if len(chunks) > _MAX_VALUES:
        least = -(-len(frames) // _MAX_VALUES)
        raise ConfigError(
            f"openjd: {len(frames)} frames in chunks of {chunk} are {len(chunks)} tasks, but a job has at "
            f"most {_MAX_VALUES}: take chunks of at least {least}"
        )
    ranges = [framesToFrameRange(part, sort=False, compress=True) for part in chunks]
    longest = max(len(text) for text in ranges)
    if longest > _MAX_LETTERS:
        raise ConfigError(
            f"openjd: the frames of one task take {longest} letters, but at most {_MAX_LETTERS} are allowed: "
            f"take smaller chunks than {chunk}, or frames in even steps"
        )
    return ranges
