"""What is wrong with masks and photographs as such, whatever the body does."""

import statistics
from collections import defaultdict
from collections.abc import Collection, Sequence

from dsar.data.captures.multiview import MultiViewCapture
from dsar.evaluation.check.finding import Finding
from dsar.evaluation.check.image_summaries import ImageSummary
from dsar.evaluation.check.mask_alignment import find_misaligned_masks

_INVERTED = 0.5
"""Share of the images' borders from which masks show the background."""
_GREY, _COLORED = 1.0, 8.0
"""Mean distances between channels, of 255: grey is below the one, colours are above the other."""
_EXPOSED = 4.0
"""Times by which a camera may be lighter or darker than the median one: two stops."""


def find_mask_faults(capture: MultiViewCapture, summaries: Sequence[ImageSummary]) -> list[Finding]:
    """Return what is wrong with masks that could be read."""
    findings = []
    shaped = [summary for summary in summaries if not summary.full]
    border = statistics.fmean(each.border for each in shaped) if shaped else 0.0
    if border > _INVERTED:
        what = f"masks cover {border:.0%} of the images' borders: they show the background; invert them"
        findings.append(Finding("masks_inverted", what, True))
    hollow = [summary for summary in summaries if summary.coverage == 0]
    for name, affected, what in (
        (
            "full_masks",
            [summary for summary in summaries if summary.full],
            "say that all of the picture is the person, and so tell nothing; save what tells the person from "
            "the rest",
        ),
        (
            "empty_masks",
            [summary for summary in hollow if summary.highest == 0],
            "are 0 in every pixel: nobody is in them. Delete these images, or make their masks anew if "
            "somebody is in the pictures",
        ),
        (
            "faint_masks",
            [summary for summary in hollow if summary.highest > 0],
            "cover no pixel by half; write them as the camera's others, the person as the highest number",
        ),
    ):
        if affected:
            first = affected[0]
            where = f"{first.sequence}, frame {first.frame}, {capture.cameras[first.camera].name}"
            highest = f", up to {first.highest} of 255" if name == "faint_masks" else ""
            what = f"{len(affected)} of {len(summaries)} masks (the first: {where}{highest}) {what}"
            findings.append(Finding(name, what, len(affected) == len(summaries)))
    return findings


def find_color_faults(
    capture: MultiViewCapture, summaries: Sequence[ImageSummary], usable: Collection[tuple[str, int, int]]
) -> list[Finding]:
    """Return what is wrong with photographs: beside their masks, and beside those of other cameras.

    Args:
        capture: Where they are from.
        summaries: Those that can be read.
        usable: Sequence, frame and camera of those whose mask has a shape.
    """
    findings = []
    views_of_camera: dict[int, list[ImageSummary]] = defaultdict(list)
    for summary in summaries:
        if (summary.sequence, summary.frame, summary.camera) in usable:
            views_of_camera[summary.camera].append(summary)
    # Colours under alpha 0 mean nothing where images are no photographs.
    for misfit in find_misaligned_masks(capture, usable) if capture.backdrop else ():
        names = ", ".join(capture.cameras[index].name for index in misfit.cameras)
        findings.append(
            Finding(
                "photographs_turned",
                f"the photographs of {names} are {misfit.how} against their masks: bring both to what the "
                "calibration was made with; mind EXIF orientation, which is followed here (colours tell "
                f"{misfit.before:.0%} of the masks, of turned ones {misfit.after:.0%})",
                True,
            )
        )
    if len(views_of_camera) < 2:
        return findings
    chroma = {
        index: statistics.median(each.chroma for each in views) for index, views in views_of_camera.items()
    }
    grey = [capture.cameras[index].name for index, value in chroma.items() if value < _GREY]
    if grey and max(chroma.values()) > _COLORED:
        what = f"the images of {', '.join(grey)} are grey, the others' have colours: leave them out"
        findings.append(Finding("grey_cameras", what))
    light = {
        index: statistics.median(each.light for each in views) for index, views in views_of_camera.items()
    }
    usual = statistics.median(light.values())
    for index, value in light.items():
        if usual > 0 and not usual / _EXPOSED <= value <= usual * _EXPOSED:
            times, how = (usual / max(value, 1e-4), "dark") if value < usual else (value / usual, "bright")
            name = capture.cameras[index].name
            what = f"{name} shows the person {times:.1f} times as {how} as the others do: match exposures"
            findings.append(Finding("camera_exposure", what))
    return findings
