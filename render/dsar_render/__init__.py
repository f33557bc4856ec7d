"""Images of a rollout: pictures with all their channels, previews, videos and contact sheets."""

from dsar_render.contact_sheet import write_contact_sheet
from dsar_render.images import PngSequence, display_image, write_png
from dsar_render.labels import Labels, label_sequence
from dsar_render.openjd import openjd_template
from dsar_render.picture import render_picture
from dsar_render.sequence import render_sequence
from dsar_render.settings import RenderSettings
from dsar_render.shot import Shot, render_shot
from dsar_render.triplets import FrameTriplet, add_neighbours, iterate_triplets
from dsar_render.video import write_mp4

__all__ = [
    "FrameTriplet",
    "Labels",
    "PngSequence",
    "RenderSettings",
    "Shot",
    "add_neighbours",
    "display_image",
    "iterate_triplets",
    "label_sequence",
    "openjd_template",
    "render_picture",
    "render_sequence",
    "render_shot",
    "write_contact_sheet",
    "write_mp4",
    "write_png",
]
