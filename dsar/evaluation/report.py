"""report.html: one self-contained page that says what a run is, how it was made and how good it is."""

import base64
import dataclasses
import json
import logging
import mimetypes
import os
import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment, StrictUndefined
from plotly.offline import get_plotlyjs

from dsar.atomic_files import write_text_atomically
from dsar.config import PRESETS, TrainConfig, absolute_capture, config_to_json
from dsar.config.migrations import RENAMED_STAGES
from dsar.evaluation.study.chart import QUALITIES, chart_points, interactive_chart, training_length_series
from dsar.evaluation.study.summary import table_cells
from dsar.training.checkpoint import Run, read_config, read_json, read_progress

LOGGER = logging.getLogger(__name__)

_STAGES = {"template": "#9aa5b1", "pretraining": "#c77d0a", "pose": "#4c78a8", "autoregressive": "#2a7f62"}
_METRICS = (
    *(
        "psnr",
        "psnr_box",
        "psnr_box_template",
        "psnr_garment",
        "psnr_uncovered",
        "ssim",
        "lpips",
        "lpips_vgg",
        "flip",
    ),
    *("tpsnr", "warp_error", "vmaf", "mmd"),
)
_PREVIEWS = (
    ("compare.mp4", "Side by side", "Truth and avatar, on a motion that training never saw."),
    ("sheet.png", "Frames it never saw", "Truth above, the avatar below."),
    ("worst.png", "Where it is worst", "The held-out views with the lowest PSNR in the mask's box."),
)


def write_report(run: Run) -> Path:
    """Write report.html from what lies in a run's folder; what was not measured yet is said to be so.

    That is config.json, metrics.jsonl, the checkpoint, previews, and the figures that `dsar eval` and
    `dsar stress` leave (figures.json, stress.json), and the tables of a study beside it.
    """
    config, lines = read_config(run), _lines(run)
    figures, battery, study = map(_read, (run.figures, run.stress, run.study))
    # Models of another capture are no measure of this one.
    study = study if study and absolute_capture(study["capture"]) == config.capture else None
    splits = {name: values for name, values in (figures or {}).get("splits", {}).items() if values}
    metrics = [key for key in _METRICS if any(values.get(key) is not None for values in splits.values())]
    facts = {
        "name": run.folder.name,
        "folder": str(run.folder),
        "plotly": get_plotlyjs(),
        "config": config,
        "settings": config_to_json(config),
        "changed": [(key, *values) for key, values in sorted(changed_settings(config).items())],
        "progress": read_progress(run),
        "lines": lines,
        "previews": list(_previews(run)),
        "figures": figures,
        "metrics": metrics,
        "splits": [(name, *(values.get(key) for key in metrics)) for name, values in splits.items()],
        "unseen": list(_unseen_tables((figures or {}).get("unseen") or {})),
        "battery": battery,
        "moments": _moments(run, battery) if battery else {},
        "stability": _draw_stability(battery) if battery else "",
        "study": study,
        "charts": list(_draw_study(study["tables"], figures)) if study else [],
        "curves": list(_draw_curves(lines)),
        "environment": _environment(),
        "tables": [(table["title"], *table_cells(table)) for table in study["tables"].values()]
        if study
        else [],
        "rows": lambda garment: [(who, *values.values()) for who, values in garment.items()],
    }
    engine = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    engine.filters["figure"] = _figure
    source = Path(__file__).with_name("report.html.jinja").read_text()
    write_text_atomically(run.report, engine.from_string(source).render(facts))
    return run.report


def changed_settings(config: TrainConfig) -> dict[str, tuple[Any, Any]]:
    """Return the settings in which a run differs from its preset: the preset's value and the run's."""
    base, own = (_flat(dataclasses.asdict(each)) for each in (PRESETS[config.preset], config))
    return {key: (base[key], own[key]) for key in own if base[key] != own[key]}


def _previews(run: Run) -> Iterator[dict[str, Any]]:
    for name, title, note in _PREVIEWS:
        path = run.previews / name
        if path.exists():
            data = _embed(path)
            yield {"title": title, "note": note, "data": data, "video": data.startswith("data:video")}


def _moments(run: Run, battery: Mapping[str, Any]) -> dict[str, str]:
    """Return the pictures of the worst moment of each case that has some."""
    paths = {case: run.stress_pictures / f"{case}.png" for case in battery["cases"]}
    return {case: _embed(path) for case, path in paths.items() if path.exists()}


def _embed(path: Path) -> str:
    """Return a picture or a video as what a page carries itself."""
    kind = mimetypes.guess_type(path.name)[0] or ""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _unseen_tables(unseen: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the table of each split of unseen motions, its last row the means over motions."""
    for split, figures in unseen.items():
        rows = [
            (
                name,
                *(each[key] for key in ("mm", "mm_template", "mm_second")),
                each["mm"] / each["mm_template"],
            )
            for name, each in (*figures["motions"].items(), ("mean", figures))
        ]
        stops = [
            (f"{name}, frame {stop['frame']}", *(value for key, value in stop.items() if key != "frame"))
            for name, each in figures["motions"].items()
            for stop in each["stops"]
        ]
        yield {"split": split, "rows": rows, "stops": stops} | {k: figures[k] for k in ("ratio", "ratio_ci")}


def _draw_stability(battery: Mapping[str, Any]) -> str:
    """Return the curves of the cases; one at a time is shown, for their units differ."""
    figure = go.Figure()
    for case, verdict in battery["cases"].items():
        shown = True if case == "stop" else "legendonly"
        figure.add_scatter(y=verdict["curve"], name=f"{case}, {verdict['unit']}", visible=shown)
    return _draw(figure, "round, cycle or frame", "the case's own measure", log=True)


def _draw_study(summary: Mapping[str, Any], figures: Mapping[str, Any] | None) -> Iterator[str]:
    """Return the study's models, speed against accuracy, and this run among them once it is measured."""
    for quality in QUALITIES:
        figure = interactive_chart(chart_points(summary), quality)
        if figures is not None:
            far = figures["splits"]["fd"] or figures["splits"]["test"]
            place = {"x": [1000 / figures["fps"]], "y": [far[quality]]}
            figure.add_scatter(
                **place, mode="markers", marker={"symbol": "star", "size": 16}, name="this run"
            )
        figure.update_xaxes(type="log")
        yield _draw(figure, "milliseconds a frame", quality, log=False)
    figure = go.Figure()
    for label, line in training_length_series(summary).items():
        updates, psnr = zip(*line, strict=True)
        figure.add_scatter(x=updates, y=psnr, name=label)
    if figure.data:
        yield _draw(figure, "updates", "psnr_box", log=False)


def _draw_curves(lines: list[dict[str, Any]]) -> Iterator[str]:
    for key, label in (("psnr", "PSNR of training crops, dB"), ("loss", "loss")):
        figure = go.Figure()
        for stage, colour in _STAGES.items():
            part = [line for line in lines if RENAMED_STAGES.get(line["stage"], line["stage"]) == stage]
            # Pre-training sees no images.
            if part and (key, stage) != ("psnr", "pretraining"):
                steps, values = [line["step"] for line in part], [line[key] for line in part]
                figure.add_scatter(x=steps, y=values, name=stage, line_color=colour)
        yield _draw(figure, "update", label, log=key == "loss")
    probed = [line for line in lines if line["gradients"]]
    if probed:
        figure = go.Figure()
        for name in sorted({name for line in probed for name in line["gradients"]}):
            shares = [line["gradients"].get(name) for line in probed]
            figure.add_scatter(x=[line["step"] for line in probed], y=shares, name=name)
        yield _draw(figure, "update", "gradient over the images'", log=True)


def _draw(figure: go.Figure, x: str, y: str, *, log: bool) -> str:
    figure.update_layout(
        template="plotly_white",
        height=340,
        margin={"l": 60, "r": 20, "t": 20, "b": 50},
        xaxis_title=x,
        yaxis_title=y,
        yaxis_type="log" if log else "linear",
    )
    return figure.to_html(full_html=False, include_plotlyjs=False)


def _environment() -> list[tuple[str, str]]:
    packages = [(name, metadata.version(name)) for name in ("dsar-avatar", "torch", "numba", "numpy")]
    machine = [("machine", platform.platform()), ("processors", str(os.cpu_count()))]
    return [("Python", platform.python_version()), *packages, *machine]


def _lines(run: Run) -> list[dict[str, Any]]:
    if not run.metrics.exists():
        return []
    lines, cut = [], 0
    for text in run.metrics.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            line = None
        # A run that was killed or had no room left has written a part of one.
        if not isinstance(line, dict):
            cut += 1
            continue
        lines.append(line)
    if cut:
        LOGGER.warning("%s: lines that are not whole, left out: %d of %d", run.metrics, cut, cut + len(lines))
    return lines


def _read(path: Path) -> dict[str, Any] | None:
    return read_json(path) if path.exists() else None


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


def _figure(value: Any) -> str:
    """Return a cell's text: numbers to four digits, a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
