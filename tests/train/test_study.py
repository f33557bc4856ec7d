"""The study: every row is a model that can be built; what is done is not done again; tables say what is."""

import dataclasses
import json

import pytest

from dsar.atomic_files import write_text_atomically
from dsar.config import PRESETS
from dsar.errors import ConfigError
from dsar.evaluation.report import write_report
from dsar.evaluation.stress import run_causal
from dsar.evaluation.study import (
    ABLATIONS,
    BASELINES,
    Row,
    Study,
    Table,
    runner,
    summarize_tables,
    to_markdown,
)
from dsar.training.checkpoint import Run

TINY = {
    "tiny": Table(
        "Tiny",
        (
            Row("full", paper={"psnr": 30.0}),
            Row("no feedback", {"model.feedback": 0}),
            Row("full, bank zeroed", zeroed=("state",)),
        ),
    )
}


def test_every_row_of_the_tables_is_a_model_that_can_be_trained(tmp_path):
    study = Study(tmp_path, 1500)
    tables = [*ABLATIONS.values(), *BASELINES.values()]
    measurements = study.measurements(tables)
    configs = {each.model.name: study.config(each.model) for each in measurements}
    # Models that differ have names that differ, and folders of their own.
    assert len({json.dumps(vars(config), default=vars) for config in configs.values()}) == len(configs)
    assert configs["feedback=0,seed=2"].model.feedback == 0
    assert configs["feedback=0,seed=2"].seed == 2
    assert configs["cameras=4,seed=0"].cameras == 4
    assert [each.model.seed for each in measurements] == sorted(each.model.seed for each in measurements)


def test_a_row_that_names_no_setting_is_refused(tmp_path):
    study = Study(tmp_path, 1500)
    with pytest.raises(ConfigError, match=r"model\.windows"):
        study.config(runner.Model({"model.windows": 3}, 0))


@pytest.fixture
def tiny_preset(monkeypatch):
    """Make the preset of the study one that trains in seconds."""
    demo = PRESETS["demo"]
    tiny = dataclasses.replace(
        demo,
        workers=1,
        atlas=dataclasses.replace(demo.atlas, resolution=32, garment="off"),
        model=dataclasses.replace(demo.model, channels=(8, 16), heads=2),
        schedule=dataclasses.replace(demo.schedule, rollouts_per_worker=2),
    )
    monkeypatch.setitem(PRESETS, "demo", tiny)


@pytest.mark.usefixtures("tiny_preset")
def test_a_study_goes_on_with_what_is_missing_and_does_nothing_twice(tiny_capture, tmp_path):
    study = Study(tmp_path, 12, str(tiny_capture), cases={"causal": run_causal})
    tables = list(TINY.values())
    # An hour's budget of none: nothing is begun.
    assert not study.run(tables, hours=0.0)
    assert summarize_tables(study, TINY)["tiny"]["rows"][0]["seeds"] == []
    told = []
    assert study.run(tables, report=lambda *what: told.append(what))
    assert {what for what, _ in told} == {
        "train full,seed=0",
        "measure full,seed=0",
        "train feedback=0,seed=0",
        "measure feedback=0,seed=0",
        "done",
    }
    assert [share for _, share in told] == sorted(share for _, share in told)
    told.clear()
    assert study.run(tables, hours=0.0, report=lambda *what: told.append(what))
    assert told == [("done", 1.0)]
    with pytest.raises(ConfigError, match=r"full,seed=0/measured\.json is of a model with other settings"):
        Study(tmp_path, 13, str(tiny_capture)).run(tables)
    (tmp_path / "feedback=0,seed=0" / "measured.json").unlink()
    with pytest.raises(ConfigError, match="feedback=0,seed=0 is of a model with other settings"):
        Study(tmp_path, 13, str(tiny_capture)).run([Table("less", (TINY["tiny"].rows[1],))])

    summary = summarize_tables(study, TINY)
    run = Run(tmp_path / "full,seed=0")
    found = {"complete": False, "steps": 12, "capture": str(tiny_capture), "tables": summary}
    write_text_atomically(run.study, json.dumps(found))
    page = write_report(run).read_text()
    for text in ("Beside other models", "not complete yet", "no feedback"):
        assert text in page
    write_text_atomically(run.study, json.dumps(found | {"capture": "embedded"}))
    assert "No study beside this run" in write_report(run).read_text()
    full, less, zeroed = summary["tiny"]["rows"]
    assert full["seeds"] == zeroed["seeds"] == [0]
    assert less["seeds"] == []
    assert full["mean"]["passed"] == 1
    assert full["mean"]["psnr"] != zeroed["mean"]["psnr"]
    text = to_markdown(summary)
    assert f"| full | 1 | {full['mean']['psnr']:.2f} |" in text
    assert text.splitlines()[2].endswith("| paper psnr |")
    assert text.splitlines()[4].endswith("| 30.00 |")
