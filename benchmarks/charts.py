"""The rasteriser benchmark's charts."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

TITLES = {"forward": "forward", "forward_backward": "forward + backward"}
MARKERS = "osD^vP*X"
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


def draw_charts(rows: list[dict], ratios: list[dict], ours: str, folder: Path) -> list[Path]:
    """Write the charts as PNG, with as many threads as were measured at most; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    threads = max(row["threads"] for row in rows)
    timed = [row for row in rows if not row["skipped"] and row["threads"] == threads]
    names = [ours, *dict.fromkeys(row["rasteriser"] for row in timed if row["rasteriser"] != ours)]
    styles = {name: (f"C{i}", MARKERS[i % len(MARKERS)]) for i, name in enumerate(names)}
    times, bars = folder / "raster_times.png", folder / "raster_ratios.png"
    _draw_times(timed, styles, threads, times)
    kept = [r for r in ratios if r["threads"] == threads and r["pass"] == "forward_backward"]
    _draw_ratios(kept, styles, threads, bars)
    return [times, bars]


def _draw_times(timed: list[dict], styles: dict, threads: int, path: Path) -> None:
    """Draw milliseconds against Gaussians: a column for each image size, a line for each rasteriser."""
    images = list(dict.fromkeys((row["width"], row["height"]) for row in timed))
    ticks = sorted({row["gaussians"] for row in timed})
    size = (4.5 * len(images) + 1, 8)
    layout = {"figsize": size, "sharex": True, "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, grid = plt.subplots(2, len(images), **layout)
    for axes_row, name in zip(grid, TITLES, strict=True):
        for axes, image in zip(axes_row, images, strict=True):
            kept = [row for row in timed if (row["width"], row["height"]) == image and row["pass"] == name]
            _draw_lines(axes, kept, styles)
            axes.set_title(f"{TITLES[name]}, {image[0]} x {image[1]} pixels")
            axes.set_xlabel("Gaussians")
            axes.set_xscale("log")
            axes.set_xticks(ticks, [f"{tick // 1000}k" for tick in ticks])
            axes.minorticks_off()
        axes_row[0].set_ylabel("median time [ms], bars: quartiles")
    lines, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(f"Rasterisers on the CPU, {threads} threads: less is better")
    _save(figure, path)


def _draw_lines(axes: Axes, rows: list[dict], styles: dict) -> None:
    """Draw every rasteriser's times at one image size."""
    for name, (color, marker) in styles.items():
        line = sorted((row for row in rows if row["rasteriser"] == name), key=lambda row: row["gaussians"])
        medians = [row["median_ms"] for row in line]
        below = [row["median_ms"] - row["low_ms"] for row in line]
        above = [row["high_ms"] - row["median_ms"] for row in line]
        axes.errorbar(
            [row["gaussians"] for row in line], medians, [below, above], label=name, color=color,
            marker=marker, capsize=3, linewidth=2.5 if name == next(iter(styles)) else 1.2,
        )  # fmt: skip
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_PLAIN)
    axes.grid(alpha=0.3)


def _draw_ratios(ratios: list[dict], styles: dict, threads: int, path: Path) -> None:
    """Draw how many times as fast as each rival ours is: a group for each scene, a bar for each rival."""
    groups: dict[str, list[dict]] = {}
    for row in ratios:
        groups.setdefault(f"{row['gaussians'] // 1000}k\n{row['width']} x {row['height']}", []).append(row)
    places, centers, bars = [], [], []
    for group in groups.values():
        start = places[-1] + 2 if places else 0
        places += range(start, start + len(group))
        centers.append(start + (len(group) - 1) / 2)
        bars += group
    figure, axes = plt.subplots(figsize=(10, 1.8 + 0.3 * (len(bars) + len(groups))), layout="constrained")
    for name, (color, _) in styles.items():
        mine = [
            (place, row["ratio"]) for place, row in zip(places, bars, strict=True) if row["rival"] == name
        ]
        if mine:
            drawn = axes.barh(*zip(*mine, strict=True), height=0.9, color=color, label=name)
            axes.bar_label(drawn, [f"{ratio:.3g}x" for _, ratio in mine], padding=3)
    axes.set_yticks(centers, list(groups))
    axes.set_ylabel("Gaussians and image")
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(_PLAIN)
    found = [1.0, *(row["ratio"] for row in bars)]
    axes.set_xlim(min(found) / 2 if min(found) < 1 else 1, 3 * max(found))
    axes.margins(y=0.02)
    axes.set_xlabel("median time of the rival / median time of ours (logarithmic)")
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    axes.set_title(f"How many times as fast ours is, forward + backward, {threads} threads")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=150)
    plt.close(figure)
