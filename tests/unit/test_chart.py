"""The chart: who is dominated, and a picture that a browser can read."""

from xml.etree import ElementTree

import pytest

from dsar.evaluation.study.chart import (
    Point,
    chart_points,
    draw_chart,
    interactive_chart,
    pareto_front,
    training_length_series,
)

POINTS = [
    Point("quick", 2.0, 20.0, 0.06, 1000.0, 1.0),
    Point("slow and good", 30.0, 22.0, 0.03, 9000.0, 0.5),
    Point("slow and bad", 20.0, 19.0, None, 9000.0, None),
    Point("middling", 10.0, 21.0, 0.07, 5000.0, 0.0),
    Point("as quick, worse", 2.0, 19.5, 0.06, 1000.0, 1.0),
]


def test_the_front_holds_who_is_beaten_by_nobody():
    assert [p.label for p in pareto_front(POINTS, "psnr_box")] == ["quick", "middling", "slow and good"]
    assert [p.label for p in pareto_front(POINTS, "lpips")] == ["quick", "slow and good"]
    for point in (POINTS[2], POINTS[4]):
        front = pareto_front(POINTS, "psnr_box")
        assert any(other.ms <= point.ms and other.psnr_box >= point.psnr_box for other in front)


def test_zeroed_and_missing_rows_are_no_models():
    mean = {
        "fps": 50.0,
        "psnr_box": 21.0,
        "lpips": None,
        "gaussians": 100.0,
        "passed": 1.0,
        "updates": 1500.0,
    }
    row = {"label": "full", "settings": {}, "zeroed": [], "mean": mean, "spread": dict.fromkeys(mean)}
    rows = [row, row | {"label": "again"}, row | {"zeroed": ["state"], "settings": {"a": 1}}]
    rows.append(row | {"settings": {"b": 1}, "mean": dict.fromkeys(mean)})
    other = {"split": "test", "rows": [row | {"settings": {"c": 1}}]}
    longer = (
        row
        | {"label": "for long"}
        | {
            "settings": {"schedule.steps": 6000},
            "mean": mean | {"psnr_box": 22.0, "updates": 6000.0},
        }
    )
    summary = {
        "table": {"split": "fd", "rows": rows},
        "time": {"split": "fd", "rows": [longer]},
        "other": other,
    }
    assert chart_points(summary) == [Point("full", 20.0, 21.0, None, 100.0, 1.0)]
    row["spread"]["psnr_box"] = 0.4
    assert chart_points(summary)[0].spread == {"psnr_box": 0.2}
    assert training_length_series(summary) == {"full": [(1500.0, 21.0), (6000.0, 22.0)]}


def test_the_interactive_chart_names_who_was_measured():
    front, models = interactive_chart(POINTS, "lpips").data
    assert list(front.y) == [0.06, 0.03]
    assert [text.partition(":")[0] for text in models.text] == [
        p.label for p in POINTS if p.lpips is not None
    ]


def test_the_picture_names_every_model(tmp_path):
    pytest.importorskip("matplotlib")
    from matplotlib import rc_context

    with rc_context({"svg.fonttype": "none"}):
        path = draw_chart(POINTS, {"quick": [(5.0, 20.0), (10.0, 20.5)]}, tmp_path / "new" / "chart.svg")
    words = {element.text for element in ElementTree.parse(path).iter() if element.text}
    assert {point.label for point in POINTS} <= words


def test_names_stand_in_nobodys_way(tmp_path):
    """Of a crowd not all have room; who has several seeds, or is on the front, comes first."""
    from matplotlib import rc_context

    crowd = [
        Point(f"model {index} of a crowd", 5.0, 20.0 + index / 1e3, 0.05, 5e3, 1.0) for index in range(60)
    ]
    several = Point("several seeds", 5.0, 20.03, 0.06, 5e3, 1.0, {"psnr_box": 0.2, "lpips": 0.001})
    with rc_context({"svg.fonttype": "none"}):
        path = draw_chart([*POINTS, *crowd, several], {}, tmp_path / "chart.svg")
    words = [element.text for element in ElementTree.parse(path).iter() if element.text]
    assert words.count("several seeds") == 2
    assert words.count("slow and good") == 2
    assert 0 < sum("of a crowd" in word for word in words) < 60
