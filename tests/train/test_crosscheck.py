"""`dsar crosscheck`, on a run and on a capture alone."""

import json
import re

import numpy as np
import pytest

import dsar_exporters
from dsar.cli import main
from dsar.errors import DsarError
from dsar.geometry.camera_faults import PROJECTION_FAULTS
from dsar_render.crosscheck.backend import LLVM, find_llvm

pytest.importorskip("mitsuba")


def check(tmp_path, *arguments: str) -> dict:
    figures = tmp_path / "crosscheck.json"
    common = ["--report", str(tmp_path / "page.html"), "--json", str(figures), "--progress", "none"]
    main(["crosscheck", *arguments, *common])
    return json.loads(figures.read_text())


def test_a_run_agrees_with_mitsuba(trained, tmp_path, capsys):
    found = check(tmp_path, str(trained))
    assert found["passed"]
    assert found["camera_px_rms"] < 0.05
    assert found["camera_px_max"] < 0.1
    assert found["silhouette_iou"] >= 0.99
    assert found["depth_mae_m"] < 1e-3
    assert found["seeded_wrong_cameras_caught"] == [mistake.name for mistake in PROJECTION_FAULTS]
    assert set(found["cameras"]) == {"cam0", "cam1", "cam2", "cam3"}
    assert all(
        set(each["residuals"]) == {"ours", "usd", "exr", "exr_lens"} for each in found["cameras"].values()
    )
    if find_llvm() is None:
        assert found["splat_psnr"] is None
        assert "libllvm19" in found["skipped"]["splat_psnr"]
    else:
        assert found["splat_psnr"] > 25
        assert found["splats"]["coverage"] < 0.005
    page = (tmp_path / "page.html").read_text()
    assert "agree" in page
    assert len(re.findall("data:image/png", page)) == (9 if found["splats"] else 3)
    assert "seeded mistakes caught: 7 of 7" in capsys.readouterr().out


def test_a_capture_alone_is_checked_by_the_scalar_variant(tiny_capture, tmp_path):
    found = check(tmp_path, "--capture", str(tiny_capture), "--variant", "scalar_rgb")
    assert found["passed"]
    assert found["variant"] == "scalar_rgb"
    assert found["splat_psnr"] is None
    assert "run" in found["skipped"]["splat_psnr"]


def test_a_file_that_says_something_else_is_named_and_fails(tiny_capture, tmp_path, capsys, monkeypatch):
    written = dsar_exporters.read_back_projections

    def wrong(cameras):
        found = written(cameras)
        shift = np.eye(4)
        shift[:2, 3] = -0.5
        found["usd"]["cam2"] = shift @ found["usd"]["cam2"]
        return found

    monkeypatch.setattr(dsar_exporters, "read_back_projections", wrong)
    with pytest.raises(SystemExit) as ended:
        check(tmp_path, "--capture", str(tiny_capture), "--variant", "scalar_rgb")
    assert ended.value.code == 1
    assert "WRONG cam2, usd: half_pixel_shift" in capsys.readouterr().out
    assert not json.loads((tmp_path / "crosscheck.json").read_text())["passed"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--capture", "{capture}", "--frame", "99"), "--frame 99: expected 0 to 9"),
        (("{run}", "--capture", "{capture}"), "expected a run or --capture, found both"),
        (("{run}", "--body", "{capture}"), "--body: expected with --capture"),
        (("--capture", "{capture}", "--variant", "cuda_ad_rgb"), f"expected {LLVM} or scalar_rgb"),
    ],
)
def test_what_cannot_be_checked_is_refused(trained, tiny_capture, tmp_path, capsys, arguments, message):
    filled = [each.format(capture=tiny_capture, run=trained) for each in arguments]
    with pytest.raises(SystemExit) as ended:
        check(tmp_path, *filled)
    assert ended.value.code == 2
    assert isinstance(ended.value.__cause__, DsarError)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "crosscheck.json").exists()
