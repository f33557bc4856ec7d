"""Draw the README's pictures: truth beside prediction, moving and still, and the study in one chart.

dsar render runs/demo --png drawn --camera cam0,cam2     # the held-out motion `far`
python tools/draw_pictures.py --rendered drawn
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image, ImageDraw, ImageFont

from dsar import open_capture
from dsar.geometry.camera_paths import START_FRAME

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "img"
SEQUENCE, CAMERAS = "far", (0, 2)
BOX = (10, 14, 182, 248)
"""Left, top, right and bottom of what is shown of an image, pixels."""
ENLARGED = 1.5
HEADING = 24
"""Height of the line above the pictures, pixels."""
MOVING = range(16, 104, 2)
"""Frames of the moving picture: rest, two turns, the abrupt stop and what follows it."""
STILL = {16: "at rest", 38: "spin", 54: "spin", 66: "stop", 72: "6 frames later", 104: "at rest"}
NAMED = {
    "full model": ("full model", (28, -20)),
    "pose only, one frame": ("pose only", (10, -12)),
    "the same, poses projected (the paradigm of Animatable-GS)": ("", (0, 0)),
    "window of poses, no streams": ("window of poses, no streams", (8, -6)),
    "pose, linear bases (the paradigm of MMLPs)": ("pose, linear bases", (8, -3)),
    "pose features at each Gaussian (the paradigm of GaussianAvatar)": (
        "features at each Gaussian",
        (-6, 12),
    ),
    "twice the channels": ("twice the channels", (6, 4)),
    "fewer texels": ("half the Gaussians", (6, 4)),
    "more texels": ("twice the Gaussians", (6, 4)),
    "the preset small": ("preset small", (-68, 4)),
}
"""Rows of the study that the chart names, how it calls them, and where, points from the mark."""


def shown(image: Image.Image) -> Image.Image:
    """Return an RGBA image over white, cut to `BOX` and enlarged."""
    flat = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB").crop(BOX)
    return flat.resize(
        (round(flat.width * ENLARGED), round(flat.height * ENLARGED)), Image.Resampling.LANCZOS
    )


def pair(capture, rendered: Path, frame: int, camera: int) -> tuple[Image.Image, Image.Image]:
    """Return truth and prediction of a frame, counted from 0."""
    name = capture.cameras[camera].name
    (path,) = (rendered / name).glob(f"*.{frame + START_FRAME:04d}.png")
    return shown(Image.fromarray(capture.image(SEQUENCE, frame, camera))), shown(
        Image.open(path).convert("RGBA")
    )


def table(rows: list[list[Image.Image]], headings: list[str]) -> Image.Image:
    """Return pictures in rows, below a line of headings."""
    width, height = rows[0][0].size
    sheet = Image.new("RGB", (width * len(rows[0]), HEADING + height * len(rows)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for column, text in enumerate(headings):
        draw.text(((column + 0.5) * width, HEADING / 2), text, fill="black", anchor="mm", font=font)
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            sheet.paste(picture, (column * width, HEADING + row * height))
    return sheet


def draw_motion(rendered: Path) -> None:
    """Write the moving picture and the still one."""
    capture = open_capture("embedded")
    frames = []
    for frame in MOVING:
        pictures = [image for camera in CAMERAS for image in pair(capture, rendered, frame, camera)]
        frames.append(table([pictures], ["truth", "DSAR"] * len(CAMERAS)))
    interval = round(1000 * MOVING.step / capture.fps)
    options = {"duration": interval, "loop": 0, "quality": 75, "method": 6}
    frames[0].save(IMAGES / "spin.webp", save_all=True, append_images=frames[1:], **options)
    rows = zip(*(pair(capture, rendered, frame, CAMERAS[0]) for frame in STILL), strict=True)
    table([list(row) for row in rows], list(STILL.values())).save(
        IMAGES / "truth_and_prediction.jpg", quality=88
    )


def draw_study() -> None:
    """Write the chart of the study: a frame's time against PSNR, and training time against PSNR."""
    tables = json.loads((ROOT / "benchmarks" / "results" / "study" / "study.json").read_text())["tables"]
    rows = {row["label"]: row for name in ("baselines", "components", "extensions", "sizes")
            for row in tables[name]["rows"] if not row["zeroed"]}  # fmt: skip
    figure, (speed, training) = plt.subplots(
        1, 2, figsize=(11, 4.2), width_ratios=(2, 1), layout="constrained"
    )
    for label, row in rows.items():
        mean, spread = row["mean"], row["spread"].get("psnr_box") or 0
        color, size = {"full model": ("C0", 9), "pose only, one frame": ("C1", 9)}.get(label, ("0.65", 6))
        place = 1000 / mean["fps"], mean["psnr_box"]
        bars = spread / 2 if size > 6 else None  # The other rows have one seed, or are not named.
        speed.errorbar(*place, bars, fmt="o", color=color, markersize=size, capsize=3, zorder=size)
        name, offset = NAMED.get(label, ("", (0, 0)))
        speed.annotate(name, place, offset, textcoords="offset points", fontsize=9, zorder=10)
    speed.set_xscale("log")
    ticks = (2.5, 3, 4, 5, 6, 8)
    speed.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    speed.minorticks_off()
    speed.set_xlabel("milliseconds a frame: network, posing and one view (two CPU cores)")
    speed.set_ylabel("PSNR in the mask's box [dB]")
    speed.set_title("Speed and accuracy after five minutes of training")
    for color, label in (("C0", "full model"), ("C1", "pose only")):
        curve = {row["settings"]["schedule.minutes"]: row["mean"]["psnr_box"]
                 for row in tables["time"]["rows"] if row["label"] == label}  # fmt: skip
        curve[5.0] = next(row for name, row in rows.items() if name.startswith(label))["mean"]["psnr_box"]
        training.plot(*zip(*sorted(curve.items()), strict=True), "o-", color=color, label=label)
    training.set_xlabel("minutes of training (two CPU cores)")
    training.set_title("With and without memory")
    training.legend()
    for axes in (speed, training):
        axes.grid(alpha=0.3)
    figure.savefig(IMAGES / "study.png", dpi=120)
    plt.close(figure)


def main() -> None:
    """Draw all of them; the moving ones where a rendered sequence is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rendered", type=Path, help="folder of PNGs: `far` from cam0 and cam2")
    arguments = parser.parse_args()
    draw_study()
    if arguments.rendered is not None:
        draw_motion(arguments.rendered)


if __name__ == "__main__":
    main()
