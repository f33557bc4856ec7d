"""Contact sheets: one picture that shows a whole run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from dsar.atomic_files import atomic_write
from dsar.errors import ExportError

_TEXT_HEIGHT = 12
_MARGIN = 4
_PAPER, _INK = (24, 24, 24), (224, 224, 224)


def write_contact_sheet(
    path: Path,
    rows: Mapping[str, Sequence[UInt8[np.ndarray, "h w 3"]]],
    *,
    columns: Sequence[str],
) -> Path:
    """Write a labelled grid of images as PNG and return its path.

    To compare, put the row of a camera's true images above the row of its predictions.

    Args:
        path: The file, which appears when it is complete; folders are made if missing.
        rows: Row label (`cam01 truth`) to its images of one height, one per column.
        columns: Column labels (`frame 1012`).

    Raises:
        ExportError: There is nothing to show, or a row has not one image per column.
    """
    if not rows or not columns:
        raise ExportError(f"{path.name}: expected rows and columns, found {len(rows)} by {len(columns)}")
    for label, images in rows.items():
        if len(images) != len(columns):
            raise ExportError(
                f"{path.name}, row {label}: expected {len(columns)} images, found {len(images)}: pass one "
                "per column"
            )
    font = ImageFont.load_default(size=_TEXT_HEIGHT)
    label_width = max(round(font.getlength(label)) for label in rows) + 2 * _MARGIN
    widths = [
        max([round(font.getlength(label)), *(images[column].shape[1] for images in rows.values())])
        for column, label in enumerate(columns)
    ]
    heights = [max(image.shape[0] for image in images) for images in rows.values()]
    lefts = label_width + np.cumsum([0, *(width + _MARGIN for width in widths)])
    tops = _TEXT_HEIGHT + 2 * _MARGIN + np.cumsum([0, *(height + _MARGIN for height in heights)])
    sheet = Image.new("RGB", (int(lefts[-1]), int(tops[-1])), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for left, label in zip(lefts, columns, strict=False):
        draw.text((int(left), _MARGIN), label, fill=_INK, font=font)
    for top, (label, images) in zip(tops, rows.items(), strict=False):
        draw.text((_MARGIN, int(top)), label, fill=_INK, font=font)
        for left, image in zip(lefts, images, strict=False):
            sheet.paste(Image.fromarray(image), (int(left), int(top)))
    with atomic_write(path) as draft:
        sheet.save(draft, format="PNG")
    return path
