"""Draw docs/img/architecture.svg: one frame's way through the code, by training and by delivery."""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

INPUT, NETWORK, GEOMETRY, TRAINING, DELIVERY = "#e8e8e8", "#cfe2f7", "#d9efd3", "#fbe3c8", "#e9d8f2"
LEGEND = {
    INPUT: "what drives it, and what it is compared with",
    NETWORK: "the network",
    GEOMETRY: "the avatar's geometry",
    TRAINING: "training",
    DELIVERY: "delivery",
}
HEIGHT = 1.0
BOXES = {
    # name: (x, y, width, colour, title, equations, where)
    "motion": (0.1, 4.6, 1.9, INPUT, "Motion", "", "data/motions"),
    "cloth": (0.1, 2.5, 1.9, INPUT, "Motion prior", "", "dynamics/solver.py"),
    "signal": (2.5, 4.6, 2.0, INPUT, "Driving signal", "", "avatar/driving.py"),
    "maps": (5.0, 4.6, 2.0, INPUT, "Input maps", "equations 4, 6", "avatar/input_maps.py"),
    "encoder": (7.6, 4.6, 2.0, NETWORK, "Encoder", "equation 5", "network/encoder.py"),
    "aggregation": (10.1, 4.6, 2.4, NETWORK, "Aggregation", "equations 7-11, 15", "network/temporal.py"),
    "bank": (13.0, 4.6, 2.0, NETWORK, "Memory bank", "equations 12-14", "network/memory.py"),
    "decoder": (15.5, 4.6, 2.0, NETWORK, "Decoder", "equation 16", "network/decoder.py"),
    "template": (15.5, 2.5, 2.0, GEOMETRY, "Template, residuals", "equation 2", "avatar/template.py"),
    "posing": (13.0, 2.5, 2.0, GEOMETRY, "Posing", "equations 1, 3", "avatar/posing.py"),
    "gaussians": (10.1, 2.5, 2.4, GEOMETRY, "Posed Gaussians", "", "types.py"),
    "raster": (7.6, 2.5, 2.0, TRAINING, "Rasteriser", "", "raster/"),
    "losses": (5.0, 2.5, 2.0, TRAINING, "Losses", "equations 17-23", "training/chunk.py"),
    "capture": (2.5, 2.5, 2.0, INPUT, "Images and masks", "", "data/captures"),
    "sequence": (10.1, 0.5, 2.4, DELIVERY, "Player", "", "avatar/player.py"),
    "usd": (13.0, 0.5, 2.0, DELIVERY, "USD, PLY, SPZ, GLB", "", "dsar_exporters"),
    "exr": (7.6, 0.5, 2.0, DELIVERY, "EXR, PNG, MP4", "", "dsar_render"),
}  # fmt: skip
ARROWS = (
    ("motion", "signal"), ("motion", "cloth"), ("cloth", "signal"), ("signal", "maps"),
    ("maps", "encoder"), ("encoder", "aggregation"),
    ("aggregation", "bank"), ("bank", "decoder"), ("decoder", "template"), ("template", "posing"),
    ("posing", "gaussians"), ("gaussians", "raster"), ("raster", "losses"), ("capture", "losses"),
    ("gaussians", "sequence"), ("sequence", "usd"), ("sequence", "exr"),
)  # fmt: skip


def edge(name: str, toward: str) -> tuple[float, float]:
    """Return where an arrow to or from another box touches a box."""
    (x, y, width, *_), (x2, y2, *_) = BOXES[name], BOXES[toward]
    if abs(y - y2) < 0.1:
        return (x + width if x2 > x else x), y + HEIGHT / 2
    return x + width / 2, (y + HEIGHT if y2 > y else y)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], **style: object) -> None:
    """Draw an arrow between two points."""
    options = {"arrowstyle": "-|>", "mutation_scale": 14, "color": "#444444", "linewidth": 1.4} | style
    axes.add_patch(FancyArrowPatch(start, end, shrinkA=0, shrinkB=0, **options))


def loop(
    axes: Axes, points: list[tuple[float, float]], color: str, text: str, at: tuple[float, float]
) -> None:
    """Draw a recurrent stream as a bent arrow with its name."""
    axes.plot(*zip(*points[:-1], strict=True), color=color, linewidth=2)
    arrow(axes, points[-2], points[-1], color=color, linewidth=2)
    axes.text(*at, text, color=color, ha="center", va="bottom", fontsize=12)


def draw(path: Path) -> None:
    """Write the drawing, as SVG or PNG."""
    # Text stays text, so that tests can read it.
    plt.rcParams |= {"svg.hashsalt": "dsar", "svg.fonttype": "none"}
    figure, axes = plt.subplots(figsize=(17.7, 7.6))
    for x, y, width, color, title, equations, where in BOXES.values():
        axes.add_patch(FancyBboxPatch((x, y), width, HEIGHT, boxstyle="round,pad=0,rounding_size=0.1",
                                      facecolor=color, edgecolor="#666666"))  # fmt: skip
        lines = [(title, 10.5, "black"), (equations, 9, "#333333"), (where, 9, "#555555")]
        lines = [line for line in lines if line[0]]
        for row, (text, size, shade) in enumerate(lines):
            axes.text(x + width / 2, y + HEIGHT * (1 - (row + 0.75) / (len(lines) + 0.5)), text, ha="center",
                      va="center", fontsize=size, color=shade)  # fmt: skip
    for start, end in ARROWS:
        arrow(axes, edge(start, end), edge(end, start))
    top = 4.6 + HEIGHT
    loop(axes, [(16.5, top), (16.5, 7.1), (8.6, 7.1), (8.6, top)], "#b03a2e",
         "geometric stream: the previous deformation (4)", (12.5, 7.15))  # fmt: skip
    loop(axes, [(14.6, top), (14.6, 6.3), (13.4, 6.3), (13.4, top)], "#1f618d",
         "state stream: hidden states (14)", (13.6, 6.35))  # fmt: skip
    axes.plot([6.0, 6.0, 8.6], [2.5 + HEIGHT, 4.05, 4.05], color="#ca6f1e", linewidth=1.6, linestyle="--")
    arrow(axes, (8.6, 4.05), (8.6, 4.6), color="#ca6f1e", linestyle="--", linewidth=1.6)
    text = "gradients, through a chunk of frames"
    axes.text(8.75, 4.05, text, color="#ca6f1e", fontsize=10.5, va="center")
    for row, (color, text) in enumerate(LEGEND.items()):
        y = 1.25 - 0.3 * row
        axes.add_patch(
            FancyBboxPatch((0.1, y), 0.3, 0.18, boxstyle="round,pad=0", facecolor=color, edgecolor="#666666")
        )
        axes.text(0.55, y + 0.09, text, fontsize=10.5, va="center")
    axes.set_xlim(0, 17.7)
    axes.set_ylim(-0.1, 7.6)
    axes.set_axis_off()
    figure.patch.set_facecolor("white")
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    figure.savefig(path, bbox_inches="tight", pad_inches=0.1, dpi=80, metadata=metadata)
    plt.close(figure)


def main() -> None:
    """Draw it into docs/img, or where --out says."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parents[1] / "docs" / "img" / "architecture.svg"
    parser.add_argument("--out", type=Path, default=default, help="an .svg or .png file")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
