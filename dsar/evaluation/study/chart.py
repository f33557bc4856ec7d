"""Speed against accuracy: where each model of the study stands, and which are dominated by another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dsar.errors import MissingDependencyError

PAPER = {
    "HumanNeRF": (0.18, 20.0567, 0.1292),
    "GaussianAvatar": (35.0, 26.2311, 0.0715),
    "Animatable-GS": (13.0, 29.5138, 0.0413),
    "DSAR, the paper's": (10.0, 31.0765, 0.0305),
}
"""Frames a second on an RTX 4090 at 940x1280, PSNR and LPIPS, as published (tables 1 and supplementary 2)."""
Quality = Literal["psnr_box", "lpips"]
_LABELS: Mapping[Quality, str] = {"psnr_box": "PSNR, dB (ours: in the mask's box)", "lpips": "LPIPS"}
_AREA = 200
"""Points² of the marker of the model with most Gaussians."""


@dataclass(frozen=True)
class Point:
    """One model."""

    label: str
    ms: float
    """Milliseconds a frame: network, posing and one view."""
    psnr_box: float
    """dB, higher is better."""
    lpips: float | None
    """Lower is better; None where it was not measured."""
    gaussians: float
    """How many it draws."""
    passed: float | None
    """Share of the stability battery's cases that it passes."""


def points_of(summary: Mapping[str, Any]) -> list[Point]:
    """Return the models of a study's summary that were measured whole, each once."""
    found: dict[str, Point] = {}
    for table in summary.values():
        for row in table["rows"]:
            mean = row["mean"]
            if not row["zeroed"] and mean["fps"]:
                values = (1000 / mean["fps"], mean["psnr_box"], mean["lpips"], mean["gaussians"])
                found.setdefault(
                    str(sorted(row["settings"].items())), Point(row["label"], *values, mean["passed"])
                )
    return list(found.values())


def pareto_front(points: Sequence[Point], quality: Quality) -> list[Point]:
    """Return the points that no other beats in both speed and quality, fastest first."""
    sign = 1 if quality == "psnr_box" else -1
    measured = [point for point in points if getattr(point, quality) is not None]
    front: list[Point] = []
    for point in sorted(measured, key=lambda p: (p.ms, -sign * getattr(p, quality))):
        if not front or sign * getattr(point, quality) > sign * getattr(front[-1], quality):
            front.append(point)
    return front


def draw_chart(points: Sequence[Point], path: Path) -> Path:
    """Draw time against PSNR and against LPIPS, and the paper's published figures on panels of their own.

    Area: Gaussians. Colour: share of the stability battery that is passed. Line: the Pareto front.

    Args:
        points: The models.
        path: .svg, .png or any other format that matplotlib writes.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("the chart", "matplotlib", "eval") from error
    figure = Figure(figsize=(13, 9), layout="constrained")
    panels = figure.subplots(2, 2)
    for column, quality in enumerate(_LABELS):
        drawn = _draw_models(panels[0][column], points, quality)
        _draw_published(panels[1][column], column + 1, quality)
        if quality == "lpips":
            # Better is up in both columns.
            for row in panels:
                row[column].invert_yaxis()
            figure.colorbar(drawn, ax=panels[0][column], label="share of the stability cases passed")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _draw_models(axes: Any, points: Sequence[Point], quality: Quality) -> Any:
    shown = [point for point in points if getattr(point, quality) is not None]
    scale = _AREA / max(point.gaussians for point in points)
    drawn = axes.scatter(
        [point.ms for point in shown],
        [getattr(point, quality) for point in shown],
        [point.gaussians * scale for point in shown],
        [point.passed or 0.0 for point in shown],
        cmap="RdYlGn",
        vmin=0,
        vmax=1,
        edgecolors="black",
        linewidths=0.5,
    )
    for point in shown:
        _name(axes, point.label, (point.ms, getattr(point, quality)))
    front = pareto_front(points, quality)
    line = [point.ms for point in front], [getattr(point, quality) for point in front]
    axes.plot(*line, "--", color="grey", linewidth=1)
    _label(axes, "milliseconds a frame, on this machine", quality)
    return drawn


def _draw_published(axes: Any, column: int, quality: Quality) -> None:
    places = {label: (1000 / figures[0], figures[column]) for label, figures in PAPER.items()}
    axes.scatter(*zip(*places.values(), strict=True), color="#4c78a8")
    for label, place in places.items():
        _name(axes, label, place)
    _label(axes, "milliseconds a frame, RTX 4090, 940x1280", quality)
    axes.set_title("Published figures: another machine, another capture, the whole image", fontsize=9)


def _name(axes: Any, label: str, place: tuple[float, float]) -> None:
    axes.annotate(label, place, (6, 4), textcoords="offset points", fontsize=7)


def _label(axes: Any, time: str, quality: Quality) -> None:
    axes.set(xscale="log", xlabel=time, ylabel=_LABELS[quality])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
