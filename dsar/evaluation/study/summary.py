"""The study's tables as numbers and as text."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

from dsar.evaluation.study.runner import Study
from dsar.evaluation.study.tables import Row, Table

_IMAGE = ("psnr", "psnr_box", "psnr_garment", "ssim", "lpips", "lpips_vgg", "flip", "tpsnr", "vmaf")
_COLUMNS = (*_IMAGE, "correlation", "unseen", "fps", "gaussians", "passed", "updates")
_DIGITS = {
    "ssim": 4,
    "lpips": 4,
    "lpips_vgg": 4,
    "flip": 4,
    "unseen": 3,
    "fps": 0,
    "gaussians": 0,
    "updates": 0,
}


class RowSummary(TypedDict):
    """A row of a table, as study.json keeps it."""

    label: str
    settings: dict[str, Any]
    """Settings that differ from the preset's."""
    zeroed: list[str]
    """Streams that are taken away when the model is measured."""
    seeds: list[int]
    """Of the runs that were measured."""
    mean: dict[str, float | None]
    """By column: over the runs that have a figure; None where none has."""
    spread: dict[str, float | None]
    """By column: the largest difference of two runs; None of fewer than two."""
    paper: dict[str, float]
    """The paper's figures by column."""


class TableSummary(TypedDict):
    """A table, as study.json keeps it."""

    title: str
    split: str
    rows: list[RowSummary]


def summarize_tables(study: Study, tables: Mapping[str, Table]) -> dict[str, TableSummary]:
    """Return each table: its rows, with means over seeds, how far seeds part, and the paper's figures."""
    return {
        name: {
            "title": table.title,
            "split": table.split,
            "rows": [_summarize(row, study.figures(row), table.split) for row in table.rows],
        }
        for name, table in tables.items()
    }


def _summarize(row: Row, runs: Sequence[Mapping[str, Any]], split: str) -> RowSummary:
    columns = [_columns_of(figures, split) for figures in runs]
    values = {key: [v for run in columns if (v := run[key]) is not None] for key in _COLUMNS}
    return {
        "label": row.label,
        "settings": dict(row.settings),
        "zeroed": list(row.zeroed),
        "seeds": [figures["seed"] for figures in runs],
        "mean": {key: statistics.fmean(v) if v else None for key, v in values.items()},
        "spread": {key: max(v) - min(v) if len(v) > 1 else None for key, v in values.items()},
        "paper": dict(row.paper),
    }


def _columns_of(figures: Mapping[str, Any], split: str) -> dict[str, float | None]:
    """Return a model's columns; those that were not measured are null."""
    # A capture that labels no sequence as far has its test split judged in its place.
    images = figures["splits"].get(split) or figures["splits"]["test"]
    pairs, battery = figures["one_to_many"], figures.get("stress")
    # Models that were measured before there were unseen motions have no such figure.
    unseen = (figures.get("unseen") or {}).get("test")
    return {key: images[key] for key in _IMAGE} | {
        "correlation": pairs and pairs["correlation"],
        "unseen": unseen and unseen["ratio"],
        "fps": figures["fps"],
        "gaussians": figures["gaussians"],
        "passed": None if battery is None else sum(c["pass"] for c in battery.values()) / len(battery),
        "updates": figures["updates"],
    }


def to_markdown(summary: Mapping[str, TableSummary]) -> str:
    """Return the tables as Markdown: ours with the spread over seeds, and the paper's beside them."""
    parts = []
    for table in summary.values():
        head, rows = table_cells(table)
        lines = [_line(cells) for cells in (head, ["---"] * len(head), *rows)]
        parts.append("\n".join([f"### {table['title']}", "", *lines]))
    return "\n\n".join(parts) + "\n"


def table_cells(table: TableSummary) -> tuple[list[str], list[list[str]]]:
    """Return a table's head and rows as text; the paper's figures stand in the last columns."""
    paper = [key for key in _IMAGE if any(key in row["paper"] for row in table["rows"])]
    head, rows = ["", "seeds", *_COLUMNS, *(f"paper {key}" for key in paper)], []
    for row in table["rows"]:
        cells = [_cell(row["mean"][key], row["spread"][key], _DIGITS.get(key, 2)) for key in _COLUMNS]
        theirs = [_cell(row["paper"].get(key), None, _DIGITS.get(key, 2)) for key in paper]
        rows.append([row["label"], str(len(row["seeds"])), *cells, *theirs])
    return head, rows


def _cell(value: float | None, spread: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}f}" + (f" ±{spread / 2:.{digits}f}" if spread is not None else "")


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
