"""Speed against accuracy: where each model of the study stands, and which are dominated by another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dsar.atomic_files import atomic_write
from dsar.errors import MissingDependencyError
from dsar.evaluation.study.summary import RowSummary, TableSummary

PAPER = {
    "HumanNeRF": (0.18, 20.0567, 0.1292),
    "GaussianAvatar": (35.0, 26.2311, 0.0715),
    "Animatable-GS": (13.0, 29.5138, 0.0413),
    "DSAR, the paper's": (10.0, 31.0765, 0.0305),
}
"""Frames a second on an RTX 4090 at 940x1280, PSNR and LPIPS, as published (tables 1 and supplementary 2)."""
Quality = Literal["psnr_box", "lpips"]
QUALITIES: tuple[Quality, ...] = ("psnr_box", "lpips")
_LABELS: Mapping[Quality, str] = {"psnr_box": "PSNR, dB (ours: in the mask's box)", "lpips": "LPIPS"}
_LENGTH, _SPLIT = "schedule.steps", "fd"
_OFFSETS = tuple((x, y) for x in (7.0, -7.0, 20.0, -20.0, 36.0, -36.0) for y in (2.0, -8.0, 12.0, -18.0))
"""Where a name may stand beside its model, points."""
_LEADER = {"arrowstyle": "-", "linewidth": 0.4, "color": "grey", "shrinkA": 0, "shrinkB": 0}
_DOT = 3
"""Half the side of the square of a model's marker that names leave free, pixels."""
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
    spread: Mapping[str, float] = field(default_factory=dict)
    """By quality: half of what its seeds part by; of models with several."""


def chart_points(summary: Mapping[str, TableSummary]) -> list[Point]:
    """Return the models of a study's summary that were measured whole and trained as long, each once."""
    points: dict[str, Point] = {}
    for row in _measured_rows(summary):
        if _LENGTH not in row["settings"]:
            point = Point(
                row["label"],
                ms=1000 / _mean(row, "fps"),
                psnr_box=_mean(row, "psnr_box"),
                lpips=row["mean"]["lpips"],
                gaussians=_mean(row, "gaussians"),
                passed=row["mean"]["passed"],
                spread={key: spread / 2 for key in QUALITIES if (spread := row["spread"][key]) is not None},
            )
            points.setdefault(_key(row["settings"]), point)
    return list(points.values())


def training_length_series(summary: Mapping[str, TableSummary]) -> dict[str, list[tuple[float, float]]]:
    """Return updates and PSNR in the box of each model that was trained for several lengths."""
    series: dict[str, dict[float, float]] = {}
    labels: dict[str, str] = {}
    for row in _measured_rows(summary):
        model = _key({key: value for key, value in row["settings"].items() if key != _LENGTH})
        series.setdefault(model, {})[_mean(row, "updates")] = _mean(row, "psnr_box")
        labels.setdefault(model, row["label"])
    return {labels[key]: sorted(lengths.items()) for key, lengths in series.items() if len(lengths) > 1}


def _measured_rows(summary: Mapping[str, TableSummary]) -> list[RowSummary]:
    # Figures of another split are of other frames.
    rows = [row for table in summary.values() if table["split"] == _SPLIT for row in table["rows"]]
    return [row for row in rows if not row["zeroed"] and row["mean"]["fps"]]


def _mean(row: RowSummary, column: str) -> float:
    value = row["mean"][column]
    assert value is not None, "every run that was measured has it"
    return value


def _key(settings: Mapping[str, Any]) -> str:
    return str(sorted(settings.items()))


def pareto_front(points: Sequence[Point], quality: Quality) -> list[Point]:
    """Return the points that no other beats in both speed and quality, fastest first."""
    sign = 1 if quality == "psnr_box" else -1
    measured = [point for point in points if getattr(point, quality) is not None]
    front: list[Point] = []
    for point in sorted(measured, key=lambda p: (p.ms, -sign * getattr(p, quality))):
        if not front or sign * getattr(point, quality) > sign * getattr(front[-1], quality):
            front.append(point)
    return front


def draw_chart(
    points: Sequence[Point], lengths: Mapping[str, Sequence[tuple[float, float]]], path: Path
) -> Path:
    """Draw time against PSNR and against LPIPS, and the paper's published figures on panels of their own.

    Area: Gaussians. Colour: share of the stability battery that is passed. Line: the Pareto front. Bars:
    what seeds part by. Models of several seeds and those on the front are named first, others where there is
    room. A fifth panel shows what longer training brings.

    Args:
        points: The models.
        lengths: Updates and PSNR by model, from `training_length_series`.
        path: .svg, .png or any other format that matplotlib writes.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("the chart", "matplotlib", "eval") from error
    figure = Figure(figsize=(20, 11), layout="constrained")
    panels = figure.subplots(2, 3, height_ratios=[2, 1])
    panels[1][2].remove()
    _draw_lengths(panels[0][2], lengths)
    for column, quality in enumerate(_LABELS):
        drawn = _draw_models(panels[0][column], points, quality)
        _draw_published(panels[1][column], column + 1, quality)
        if quality == "lpips":
            # Better is up in both columns.
            for row in panels:
                row[column].invert_yaxis()
            figure.colorbar(drawn, ax=panels[0][column], label="share of the stability cases passed")
    figure.draw_without_rendering()
    # Places in the picture are known only now.
    for column, quality in enumerate(QUALITIES):
        _name_models(panels[0][column], points, quality)
    with atomic_write(path) as draft:
        figure.savefig(draft, format=path.suffix.lstrip(".").lower() or None)
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
        if quality in point.spread:
            place = point.ms, getattr(point, quality)
            axes.errorbar(*place, point.spread[quality], color="black", linewidth=0.8, capsize=3, zorder=0)
    front = pareto_front(points, quality)
    line = [point.ms for point in front], [getattr(point, quality) for point in front]
    axes.plot(*line, "--", color="grey", linewidth=1)
    _label(axes, "milliseconds a frame, on this machine", quality)
    return drawn


def _name_models(axes: Any, points: Sequence[Point], quality: Quality) -> None:
    """Name models where a name finds room beside what is named already."""
    from matplotlib.transforms import Bbox

    front = pareto_front(points, quality)
    shown = [point for point in points if getattr(point, quality) is not None]
    dots = axes.transData.transform([(point.ms, getattr(point, quality)) for point in shown])
    taken = [Bbox([dot - _DOT, dot + _DOT]) for dot in dots]
    for point in sorted(shown, key=lambda p: (not p.spread, p not in front)):
        place = point.ms, getattr(point, quality)
        for offset in _OFFSETS:
            name = _name(axes, point.label, place, offset)
            box = name.get_window_extent()
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                axes.annotate("", place, offset, textcoords="offset points", arrowprops=_LEADER, zorder=0)
                break
            name.remove()


def _draw_lengths(axes: Any, lengths: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    for label, line in lengths.items():
        axes.plot(*zip(*line, strict=True), "o-", label=label)
    axes.set(xlabel="updates", ylabel=_LABELS["psnr_box"])
    if lengths:
        axes.legend()


def interactive_chart(points: Sequence[Point], quality: Quality) -> Any:
    """Return the same panel of time against a quality as a plotly figure that names its points."""
    import plotly.graph_objects as go

    shown = [point for point in points if getattr(point, quality) is not None]
    largest = max((point.gaussians for point in shown), default=1.0)
    figure, front = go.Figure(), pareto_front(points, quality)
    place = [point.ms for point in front], [getattr(point, quality) for point in front]
    figure.add_scatter(
        x=place[0], y=place[1], mode="lines", line={"dash": "dash", "color": "grey"}, name="front"
    )
    figure.add_scatter(
        x=[point.ms for point in shown],
        y=[getattr(point, quality) for point in shown],
        mode="markers",
        text=[f"{point.label}: {point.gaussians:.0f} Gaussians" for point in shown],
        marker={
            "size": [24 * (point.gaussians / largest) ** 0.5 for point in shown],
            "color": [point.passed or 0.0 for point in shown],
            "cmin": 0,
            "cmax": 1,
            "colorscale": "RdYlGn",
            "colorbar": {"title": "stability"},
        },
        name="models",
    )
    return figure


def _draw_published(axes: Any, column: int, quality: Quality) -> None:
    places = {label: (1000 / figures[0], figures[column]) for label, figures in PAPER.items()}
    axes.scatter(*zip(*places.values(), strict=True), color="#4c78a8")
    for label, place in places.items():
        _name(axes, label, place)
    _label(axes, "milliseconds a frame, RTX 4090, 940x1280", quality)
    axes.set_title("Published figures: another machine, another capture, the whole image", fontsize=9)


def _name(axes: Any, label: str, place: tuple[float, float], offset: tuple[float, float] = (6, 4)) -> Any:
    side = "left" if offset[0] > 0 else "right"
    return axes.annotate(label, place, offset, textcoords="offset points", fontsize=7, ha=side, va="center")


def _label(axes: Any, time: str, quality: Quality) -> None:
    from matplotlib.ticker import LogFormatter

    axes.set(xscale="log", xlabel=time, ylabel=_LABELS[quality])
    # Over more than a decade only some of the numbers between its powers have room.
    for formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        formatter(LogFormatter(minor_thresholds=(1, 1)))
