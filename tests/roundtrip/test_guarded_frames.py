"""What guards found in a frame is in every delivery of it."""

import dataclasses
import json
import math

import OpenEXR
import pytest
import torch
from pxr import Sdf

from dsar.geometry.camera_paths import CameraPath
from dsar.types import GaussianSequence, GuardedFrame
from dsar_exporters import ExrSequence, PlySequence, UsdAsset, export
from dsar_render import RenderSettings, Shot, render_shot

FOUND = {
    1002: GuardedFrame({"far": 1.75, "size": 2.5}, 0.875),
    1003: GuardedFrame({}, 0.75),
    1005: GuardedFrame({"finite": math.inf}, 0.875),
}


@pytest.fixture
def guarded(figure) -> GaussianSequence:
    """A rollout that finds as it goes: nothing is known before a frame is made."""
    found: dict[int, GuardedFrame] = {}

    def produce():
        found.clear()
        for number, gaussians in figure:
            if number in FOUND:
                found[number] = FOUND[number]
            yield gaussians

    return dataclasses.replace(figure, produce=produce, guarded=found)


def test_manifest_and_usd_name_guarded_frames(guarded, tmp_path):
    export(guarded, [UsdAsset(tmp_path / "a.usda", "anna"), PlySequence(tmp_path / "splats", "anna")])
    for name in ("a.usda", "splats"):
        manifest = json.loads((tmp_path / f"{name}.manifest.json").read_text())
        assert manifest["guarded"] == {
            "1002": {"exceeded": {"far": 1.75, "size": 2.5}, "held": 0.875},
            "1003": {"exceeded": {}, "held": 0.75},
            "1005": {"exceeded": {"finite": None}, "held": 0.875},
        }
    data = Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda")).customLayerData["dsar"]
    assert data["run"] == "test"
    assert data["guarded"] == {
        "1002": "far=1.75 size=2.5 held=0.875",
        "1003": "held=0.75",
        "1005": "finite=inf held=0.875",
    }


@pytest.mark.parametrize("aovs", [("rgba",), ("rgba", "motion")], ids=["alone", "with neighbours"])
def test_exr_headers_name_guarded_frames(guarded, front, tmp_path, aovs):
    writer = ExrSequence(tmp_path, "a", aovs)
    shot = Shot((CameraPath((front,)),), (writer,), RenderSettings(aovs))
    frames = [1001, 1002, 1005]
    with torch.no_grad():
        for _ in render_shot(shot, guarded, frames):
            pass
    headers = {}
    for frame in frames:
        path = tmp_path / front.name / f"a.{front.name}.{frame}.exr"
        with OpenEXR.File(str(path), header_only=True) as file:
            headers[frame] = file.header().get("dsar/guarded")
    assert headers == {
        1001: None,
        1002: "far=1.75 size=2.5 held=0.875",
        1005: "finite=inf held=0.875",
    }


def test_a_frame_between_two_is_as_bad_as_the_worse():
    one, other = FOUND[1002], GuardedFrame({"size": 3.0, "jitter": 1.6}, 0.1)
    assert one.merged(other) == GuardedFrame({"far": 1.75, "jitter": 1.6, "size": 3.0}, 0.875)
    assert one.merged(other) == other.merged(one)
