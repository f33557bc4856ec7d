"""The network benchmark's chart."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import FuncFormatter, NullFormatter

TITLES = {
    "rollout": "the network, one frame of one person",
    "frame": "a whole frame: maps, network, posing, image",
    "training": "the network, one frame with its gradients",
}


def draw_chart(rows: list[dict], path: Path) -> None:
    """Draw the milliseconds of every design: a panel for each pass, a group for each size of the network."""
    designs = list(dict.fromkeys(row["design"] for row in rows))
    cases = list(dict.fromkeys((row["preset"], row["window"]) for row in rows))
    figure, panels = plt.subplots(1, len(TITLES), figsize=(18, 4.5), layout="constrained")
    for axes, (name, title) in zip(panels, TITLES.items(), strict=True):
        timed = {(row["design"], row["preset"], row["window"]): row for row in rows
                 if row["pass"] == name}  # fmt: skip
        for k, design in enumerate(designs):
            found = [(i, timed[design, *case]) for i, case in enumerate(cases) if (design, *case) in timed]
            places = [i + 0.2 * (k - (len(designs) - 1) / 2) for i, _ in found]
            medians = [row["median_ms"] for _, row in found]
            spread = [[row["median_ms"] - row["low_ms"] for _, row in found],
                      [row["high_ms"] - row["median_ms"] for _, row in found]]  # fmt: skip
            bars = axes.bar(places, medians, 0.19, yerr=spread, capsize=2, label=design)
            axes.bar_label(bars, [f"{ms:.3g}" for ms in medians], padding=2, fontsize=8)
        axes.set_xticks(range(len(cases)), [f"{preset}\nn = {window}" for preset, window in cases])
        axes.set_yscale("log")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.margins(y=0.15)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_title(title)
        axes.set_ylabel("median [ms], bars: quartiles")
        axes.grid(axis="y", alpha=0.3)
    panels[0].legend(title="design")
    figure.suptitle("The network in each wiring and the paper's literal design: less is better")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)
