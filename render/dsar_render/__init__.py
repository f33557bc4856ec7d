"""Images of a rollout: frames from every camera, previews, videos and contact sheets."""

from dsar_render.images import display_image, write_png
from dsar_render.sequence import render_sequence
from dsar_render.sheet import write_sheet
from dsar_render.video import write_mp4

__all__ = ["display_image", "render_sequence", "write_mp4", "write_png", "write_sheet"]
