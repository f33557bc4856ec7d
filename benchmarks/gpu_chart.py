"""The GPU benchmark's chart."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

Bars = list[tuple[str, float]]
"""What is measured, and its value."""


def draw_chart(sections: dict[str, dict], path: Path) -> None:
    """Draw a panel for the rasterisers, the network, the whole frame and training."""
    rows = {name: [row for row in entry["rows"] if not row["skipped"]] for name, entry in sections.items()}
    gsplat = [row for row in rows.get("gsplat", []) if row.get("kind") == "time"]
    panels: dict[str, Bars] = {
        "rasterising [ms]": [(_raster_label(row), row["median_ms"]) for row in rows["raster"] + gsplat],
        "the network [ms]": [(_network_label(row), row["median_ms"]) for row in rows["network"]],
        "a whole frame [ms]": [
            (f"{row['precision']}, {part}", milliseconds)
            for row in rows["frame"]
            for part, milliseconds in (row["parts_ms"] | {"whole": row["median_ms"]}).items()
        ],
        "an update of training [ms]": [
            (f"{row['preset']} {row['stage']} ({row['device']})", row["median_ms"])
            for row in rows["training"] + rows.get("cpu training", [])
        ],
    }
    longest = max(len(bars) for bars in panels.values())
    layout = {"figsize": (24, 3 + 0.22 * longest), "layout": "constrained"}
    figure, grid = plt.subplots(1, len(panels), **layout)
    for axes, (title, bars) in zip(grid, panels.items(), strict=True):
        _draw_bars(axes, title, bars)
    figure.suptitle("DSAR on one device: less is better (medians, logarithmic)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_bars(axes: Axes, title: str, bars: Bars) -> None:
    """Draw one panel; a section that failed leaves it empty."""
    axes.set_title(title)
    if not bars:
        axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes)
        return
    drawn = axes.barh(range(len(bars)), [value for _, value in bars])
    axes.bar_label(drawn, [f"{value:.3g}" for _, value in bars], padding=3, fontsize=7)
    axes.set_yticks(range(len(bars)), [label for label, _ in bars], fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.margins(x=0.15)


def _raster_label(row: dict) -> str:
    views = "" if row["views"] == 1 else f" x {row['views']}, {'at once' if row['at_once'] else 'one by one'}"
    size = f"{row['gaussians'] / 1000:g}k, {row['width']} x {row['height']}"
    return f"{row['backend']} {row['pass'].replace('_', ' + ')}, {size}{views}"


def _network_label(row: dict) -> str:
    return f"{row['preset']} {row['pass']}: {row['design']}, {row['precision']}, {row['start']}"
