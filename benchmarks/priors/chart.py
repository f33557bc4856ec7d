"""The chart of the candidates: what a frame costs against how well cloth moves."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

KINDS = {"regression": ("C0", "o"), "simulation": ("C1", "s")}
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


def draw_chart(results: list[dict], path: Path) -> None:
    """Draw a panel for each subject: milliseconds a frame and the error over the template's."""
    layout = {"figsize": (8 * len(results), 8), "sharey": True, "squeeze": False, "layout": "constrained"}
    figure, panels = plt.subplots(1, len(results), **layout)
    for axes, found in zip(panels[0], results, strict=True):
        _draw(axes, found)
    panels[0][0].set_ylabel("error on unseen validation / template's")
    figure.suptitle("Candidates for a motion prior on true cloth: lower left is better")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _draw(axes: Axes, found: dict) -> None:
    shown = [row for row in found["rows"] if row["ms"]]
    for kind, (color, marker) in KINDS.items():
        rows = [row for row in shown if row["name"].startswith(kind)]
        places = [row["ms"] for row in rows], [row["ratio"] for row in rows]
        axes.scatter(*places, c=color, marker=marker, label=kind, s=40)
        for row in rows:
            name = row["name"].removeprefix(kind).strip(",: ") or "usual constants"
            place = (row["ms"], row["ratio"])
            axes.annotate(name, place, (5, 3), textcoords="offset points", fontsize=7)
    axes.axhline(1, color="grey", linestyle="--", linewidth=1, label="template")
    axes.set_xscale("log")
    axes.set_xlim(0.03, 2)
    axes.xaxis.set_major_formatter(_PLAIN)
    axes.set_xlabel("processor time a frame [ms]; regressions in plain NumPy")
    axes.set_title(found["subject"])
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
