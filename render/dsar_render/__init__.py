"""Images of a rollout: pictures with all their channels, previews, videos and contact sheets."""

from dsar_render.images import PngSequence, display_image, write_png
from dsar_render.instants import Instant, iterate_instants, with_neighbours
from dsar_render.labels import Labels, labels_of
from dsar_render.openjd import openjd_template
from dsar_render.picture import RenderSettings, take_picture
from dsar_render.sequence import render_sequence
from dsar_render.sheet import write_sheet
from dsar_render.shot import Shot, render_shot
from dsar_render.video import write_mp4

__all__ = [
    "Instant",
    "Labels",
    "PngSequence",
    "RenderSettings",
    "Shot",
    "display_image",
    "iterate_instants",
    "labels_of",
    "openjd_template",
    "render_sequence",
    "render_shot",
    "take_picture",
    "with_neighbours",
    "write_mp4",
    "write_png",
    "write_sheet",
]
