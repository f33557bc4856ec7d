"""Every command of the README on a trained run, its files read back by readers that are not ours."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.body.files import load_body
from dsar.cli import main
from dsar.cli.train import Train
from dsar.config import PRESETS
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.evaluation import heldout
from dsar.evaluation.report import write_report
from dsar.evaluation.results import StopFigures, UnseenMotion
from dsar.evaluation.stress import run_causal, run_stop
from dsar.evaluation.unseen import summarize_motions
from dsar.training.checkpoint import Run


def command(*arguments):
    main([*map(str, arguments), "--progress", "none"])


def exit_code(*arguments) -> int:
    """Return the code with which a command ends."""
    try:
        command(*arguments)
    except SystemExit as stop:
        return int(stop.code)
    return 0


def failure(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as stop:
        command(*arguments)
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("dsar: ")
    assert message.count("\n") == 1
    return message


def test_export_writes_usd_and_ply_of_the_same_frames(trained, tmp_path):
    from plyfile import PlyData
    from pxr import Usd, UsdGeom

    command(
        "export", trained, "--usd", tmp_path / "out.usda", "--ply", tmp_path / "ply", "--json", tmp_path / "j"
    )
    facts = json.loads((tmp_path / "j").read_text())
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1010)
    assert stage.GetFramesPerSecond() == 30
    (instancer,) = [p for p in stage.Traverse() if p.IsA(UsdGeom.PointInstancer)]
    positions = np.array(UsdGeom.PointInstancer(instancer).GetPositionsAttr().Get(1004))
    ply = PlyData.read(str(tmp_path / "ply" / "avatar.1004.ply"))["vertex"]
    assert len(positions) == facts["gaussians"]
    assert np.allclose(positions, np.stack([ply["x"], ply["y"], ply["z"]], -1), atol=1e-6)
    assert sorted(path.name for path in (tmp_path / "ply").iterdir())[-1] == "avatar.1010.ply"


def test_one_export_writes_every_format_and_says_what_it_cost(trained, tmp_path):
    from pxr import Usd, UsdGeom, UsdSkel

    flags = {"usd": "a.usda", "ply": "ply", "compressed-ply": "small", "spz": "spz", "glb": "a.glb"}
    places = [part for flag, name in flags.items() for part in (f"--{flag}", tmp_path / name)]
    options = ("--half", "--clips", "--sh-degree", "3", "--frames", "1002-1006x2", "--name", "anna")
    command("export", trained, *places, *options, "--json", tmp_path / "j")
    facts = json.loads((tmp_path / "j").read_text())
    assert set(facts["written"]) == {"usd", "ply", "compressed_ply", "spz", "glb"}
    assert all(cost["bytes"] > 1000 and cost["files"] > 1 for cost in facts["cost"].values())
    for folder, suffix in (("ply", "ply"), ("small", "compressed.ply"), ("spz", "spz")):
        names = sorted(path.name for path in (tmp_path / folder).iterdir())
        assert names == [f"anna.{frame}.{suffix}" for frame in (1002, 1004, 1006)]
    assert len(list((tmp_path / "a.clips").glob("*.usdc"))) == 3
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    kinds = {prim.GetTypeName() for prim in stage.Traverse()}
    assert {"PointInstancer", "ParticleField3DGaussianSplat", "Skeleton", "SkelAnimation", "Camera"} <= kinds
    assert UsdGeom.Camera.Get(stage, "/anna/cameras/turntable")
    assert UsdSkel.Animation.Get(stage, "/anna/body/skeleton/motion").GetRotationsAttr().GetTimeSamples() == [
        1002,
        1004,
        1006,
    ]
    command("export", "--check", tmp_path / "a.usda", "--json", tmp_path / "check.json")
    assert json.loads((tmp_path / "check.json").read_text())["faults"] == []


def test_suffixes_of_outputs_may_be_in_capitals(trained, tmp_path):
    from pxr import Usd

    places = ("--usd", tmp_path / "A.USDA", "--glb", tmp_path / "A.GLB")
    command("export", trained, *places, "--frames", "1001-1002")
    assert Usd.Stage.Open(str(tmp_path / "A.USDA")).GetEndTimeCode() == 1002
    assert (tmp_path / "A.payload.usdc").exists()
    for name in ("A.USDA", "A.GLB"):
        command("export", "--check", tmp_path / name)


def test_a_faulty_file_is_told_and_exits_with_2(tmp_path, capsys):
    values = "point3f[] positions = [(0, 0, 0)]\nint[] protoIndices = [0, 0]"
    (tmp_path / "a.usda").write_text(f'#usda 1.0\ndef PointInstancer "a" {{\n{values}\n}}\n')
    with pytest.raises(SystemExit) as stop:
        command("export", "--check", tmp_path / "a.usda")
    assert stop.value.code == 2
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("WRONG /a: expected 2 positions, found 1") for line in lines)
    assert "faults" in lines[-1]
    assert "expected a file to check" in failure(capsys, "export", "--check", tmp_path / "none.usda")


def test_render_writes_sequences_per_camera(trained, tmp_path):
    import OpenEXR

    command(
        *(
            "render",
            trained,
            "--exr",
            tmp_path / "exr",
            "--png",
            tmp_path / "png",
            "--mp4",
            tmp_path / "out.mp4",
        ),
        *("--frames", "1001-1005x2", "--res", "96", "128"),
    )
    for camera in ("cam0", "cam3"):
        names = sorted(path.name for path in (tmp_path / "exr" / camera).iterdir())
        assert names == [f"avatar.{camera}.{frame}.exr" for frame in (1001, 1003, 1005)]
    with OpenEXR.File(str(tmp_path / "exr" / "cam0" / "avatar.cam0.1003.exr")) as file:
        rgba = file.channels()["RGBA"].pixels
    png = np.asarray(Image.open(tmp_path / "png" / "cam0" / "avatar.cam0.1003.png")) / 255
    assert png.shape == rgba.shape == (128, 96, 4)
    assert np.abs(png[..., 3] - rgba[..., 3]).max() < 0.01
    assert (tmp_path / "out.mp4").stat().st_size > 1000


def test_a_motion_file_drives_the_avatar_as_the_capture_does(trained, tiny_capture, tmp_path):
    from plyfile import PlyData

    motion = open_capture(tiny_capture).motions["bend"]
    write_motion(tmp_path / "m.npz", motion, load_body())
    command("export", trained, "--motion", tmp_path / "m.npz", "--ply", tmp_path / "a")
    command("export", trained, "--motion", "bend", "--ply", tmp_path / "b")
    a, b = (PlyData.read(str(tmp_path / x / "avatar.1008.ply"))["vertex"]["x"] for x in "ab")
    assert np.allclose(a, b, atol=1e-4)


def test_eval_reports_what_the_contract_names(trained, tmp_path, monkeypatch):
    monkeypatch.setenv("DSAR_CACHE", str(tmp_path))
    command("eval", trained, "--json", tmp_path / "eval.json")
    figures = json.loads((tmp_path / "eval.json").read_text())
    assert set(figures["splits"]) == {"train", "test", "nd", "fd"}
    test = figures["splits"]["test"]
    assert test["psnr"] > test["psnr_box"] > 8
    assert test["views"] == 4
    assert 0 < test["flip"] < 1
    assert 10 < test["tpsnr"] < 60
    assert 0 < test["warp_error"] < 0.05
    assert test["lpips"] is None
    assert "fetch_lpips" in figures["skipped"]["lpips"]
    assert all(key in figures["skipped"] for key, value in test.items() if value is None)
    assert figures["one_to_many"] is None
    assert set(figures["garment"].values()) == {None}
    assert "garment" in figures["skipped"]
    assert figures["unseen"] is None
    assert figures["skipped"]["unseen"] == "no unseen motions in the capture"
    assert figures["gaussians"] > 400
    assert figures["fps"] > 0


class Page(HTMLParser):
    """Collects what a page asks the network for and what it carries, its words, and tags left open."""

    def __init__(self, text):
        super().__init__()
        self.asked, self.carried, self.words, self.open = [], [], "", []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        sources = [value for key, value in attributes if key in ("src", "href")]
        self.asked += [source for source in sources if not source.startswith("data:")]
        self.carried += [source for source in sources if source.startswith("data:")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.words += data


def test_a_run_has_a_report_that_needs_nothing_else(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("dsar.evaluation.stress.CASES", {"causal": run_causal, "stop": run_stop})
    run = tmp_path / "<run> & more"
    shutil.copytree(trained, run)
    (run / "figures.json").unlink(missing_ok=True)
    write_report(Run(run))
    page = Page((run / "report.html").read_text())
    assert page.asked == []
    assert page.open == []
    assert "<run> & more" in page.words
    assert page.words.count("Not measured yet") == 2
    assert "model.window" in page.words, "settings that differ from the preset's"

    command("eval", run, "--json", tmp_path / "eval.json")
    code = exit_code("stress", run, "--json", tmp_path / "stress.json")
    figures, battery = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("eval", "stress"))
    assert figures == json.loads((run / "figures.json").read_text())
    assert set(battery["cases"]) == {"causal", "stop"}
    assert battery["tried"] == 2
    assert battery["survived"] == sum(case["pass"] for case in battery["cases"].values())
    assert code == int(battery["survived"] < battery["tried"])
    assert battery["analysis"]["lyapunov_per_s"]
    page = Page((run / "report.html").read_text())
    assert page.asked == []
    assert "Not measured yet" not in page.words
    shown = " ".join(page.words.split())
    assert all(" ".join(case["reason"].split()) in shown for case in battery["cases"].values())
    assert "Lyapunov exponent" in shown
    before = (run / "stress.json").read_bytes()
    assert exit_code("stress", run, "--cases", "causal") == 0
    assert (run / "stress.json").read_bytes() == before
    assert "--cases: no case dance" in failure(capsys, "stress", run, "--cases", "dance")
    assert f"{figures['splits']['test']['psnr_box']:.4g}" in page.words
    kinds = [each.partition(";")[0] for each in page.carried]
    assert sorted(kinds) == ["data:image/png"] * 4 + ["data:video/mp4"], "two are of the cases' worst moments"
    worst = figures["worst"]
    assert [view["psnr_box"] for view in worst] == sorted(view["psnr_box"] for view in worst)
    assert len({(view["sequence"], view["frame"]) for view in worst}) == len(worst)


def test_unseen_motions_are_told_kept_and_shown(trained, tmp_path, monkeypatch, capsys):
    stop = StopFigures(20, 1.5, 0.6, 1.25, 80.0, 164.0)
    found = {
        "validation": {
            "leap": UnseenMotion(61.5, 123.0, 9.0, 90, [stop]),
            "waltz": UnseenMotion(30.0, 60.0, None, 80, []),
        },
        "test": {"dance": UnseenMotion(77.7, 111.0, 8.0, 70, [])},
    }
    monkeypatch.setattr(heldout, "unseen_missing", lambda *_: None)
    summaries = {split: summarize_motions(motions) for split, motions in found.items()}
    monkeypatch.setattr(heldout, "measure_unseen", lambda *_: summaries)
    shutil.copytree(trained, tmp_path / "run")
    command("eval", tmp_path / "run", "--json", tmp_path / "eval.json")
    figures = json.loads((tmp_path / "eval.json").read_text())
    assert "unseen" not in figures["skipped"]
    assert figures["unseen"]["test"]["ratio"] == pytest.approx(0.7)
    assert figures["unseen"]["validation"]["ratio_ci"] == [0.5, 0.5]
    assert figures["unseen"]["validation"]["motions"]["leap"] == dataclasses.asdict(
        found["validation"]["leap"]
    )
    printed = capsys.readouterr().out
    assert "unseen validation: 45.8 mm, template 91.5" in printed
    assert "unseen test: 77.7 mm" in printed
    page = Page((tmp_path / "run" / "report.html").read_text())
    assert page.open == []
    for word in ("leap", "123", "waltz", "dance", "77.7", "leap, frame 20", "1.25", "164"):
        assert word in page.words


def test_training_says_how_gradients_compare(trained):
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert lines[0]["gradients"] is None, "the template has no regularisers"
    shares = lines[-1]["gradients"]
    assert {"spatial", "prediction", "feature", "smoothness"} <= shares.keys()
    assert all(0 < share < 1 for share in shares.values())


def test_settings_that_cannot_work_are_refused_before_any_work(tiny_capture, tmp_path, capsys):
    start = ("train", tiny_capture, "--out", tmp_path / "run", "--atlas.garment", "off")
    assert "4 cameras" in failure(capsys, *start, "--schedule.views", "9")
    assert "cameras is 7" in failure(capsys, *start, "--cameras", "7")
    assert "pixel_shuffle is 0" in failure(capsys, *start, "--model.pixel-shuffle", "0")
    assert "--model.readout mean" in failure(capsys, *start, "--model.no-causal")
    assert "GiB" in failure(capsys, *start, "--schedule.rollouts-per-worker", "1000000")
    assert not (tmp_path / "run").exists()


def test_every_ablation_of_the_paper_is_a_flag(monkeypatch):
    """As docs/paper.md names them."""
    table = Path(__file__).parents[2] / "docs" / "paper.md"
    rows = table.read_text().split("## Its ablations")[1].split("## ")[0].splitlines()
    flags = [flag for row in rows if row.startswith("|") for flag in re.findall(r"`(--[^`]*)`", row)]
    configs = []
    monkeypatch.setattr(Train, "run", lambda self: configs.append(self.config()))
    for flag in flags:
        main(["train", "--preset", "paper", *re.sub(r" [NM]\b", " 7", flag).split()])
    assert len(flags) >= 12
    assert PRESETS["paper"] not in configs
    for config in configs:
        dataclasses.replace(config, model=dataclasses.replace(config.model, readout="mean")).validate()


def test_mistakes_are_one_line_and_exit_two(trained, tmp_path, capsys):
    assert "--usd" in failure(capsys, "export", trained)
    assert "cam0" in failure(capsys, "render", trained, "--png", tmp_path, "--camera", "cam9")
    assert "nowhere.npz" in failure(capsys, "export", trained, "--ply", tmp_path, "--motion", "nowhere.npz")
    assert "1001-1010" in failure(capsys, "export", trained, "--ply", tmp_path, "--frames", "2000")
    assert "checkpoint" in failure(capsys, "export", tmp_path, "--ply", tmp_path)
    assert "cuda:N" in failure(capsys, "eval", trained, "--device", "tpu")
    assert not list(tmp_path.iterdir())


def test_the_python_interface_says_the_same(trained, tiny_capture):
    import dsar

    capture = dsar.open_capture(tiny_capture)
    sequence = dsar.roll_out(dsar.load(trained), capture.motions["bend"])
    frame, gaussians = next(iter(sequence))
    image = dsar.rasterize(gaussians, capture.cameras[0])
    assert frame == 1001
    assert image.color.shape == (64, 48, 3)
    assert torch.isfinite(image.color).all()


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("train", "--model.window"),
        ("export", "--usd"),
        ("render", "--exr"),
        ("eval", "--ablations"),
        ("stress", "--json"),
        ("crosscheck", "--capture"),
    ],
)
def test_help_of_every_command_names_its_flags(name, flag, capsys):
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert flag in capsys.readouterr().out


def test_the_module_is_the_command():
    arguments = [sys.executable, "-m", "dsar", "export", "--help"]
    assert "--usd" in subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
