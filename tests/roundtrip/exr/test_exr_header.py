"""What the header says of time, shutter, lens and origin."""

import dataclasses
from fractions import Fraction

import pytest
import torch
from exr_files import (
    PROVENANCE,
    flat_picture,
    header_of,
    parts_of,
    write,
)


@pytest.mark.parametrize(
    ("frame", "fps", "rate", "code"),
    [
        (1001, 24.0, (24, 1), (0, 0, 41, 17)),
        (0, 24.0, (24, 1), (0, 0, 0, 0)),
        (24 * 3661 + 5, 24.0, (24, 1), (1, 1, 1, 5)),
        (24 * 86400 + 7, 24.0, (24, 1), (0, 0, 0, 7)),
        # NTSC's frames are counted as if they were whole.
        (1001, 23.976, (24000, 1001), (0, 0, 41, 17)),
        (1001, 24000 / 1001, (24000, 1001), (0, 0, 41, 17)),
        (1019, 29.97, (30000, 1001), (0, 0, 33, 29)),
        (1024, 25.0, (25, 1), (0, 0, 40, 24)),
        # Above thirty a second, time codes count in twos or more: they have no more numbers.
        (1007, 48.0, (48, 1), (0, 0, 20, 23)),
        (1007, 59.94, (60000, 1001), (0, 0, 16, 23)),
        (1079, 60.0, (60, 1), (0, 0, 17, 29)),
        (1079, 120.0, (120, 1), (0, 0, 8, 29)),
        (-3, 24.0, (24, 1), (0, 0, 0, 0)),
    ],
)
def test_the_header_tells_the_time(small, tmp_path, frame, fps, rate, code):
    picture = flat_picture(torch.ones(3), torch.tensor(1.0), small)
    (path,) = write(tmp_path, dataclasses.replace(picture, frame=frame, fps=fps), layers=("rgba",))
    header = header_of(path)
    assert header["framesPerSecond"] == Fraction(*rate)
    assert header["imageCounter"] == frame
    stored = header["timeCode"]
    assert (stored.hours, stored.minutes, stored.seconds, stored.frame) == code
    assert header["dsar/frame"] == str(frame)
    assert float(header["dsar/seconds"]) == pytest.approx(frame * rate[1] / rate[0], abs=1e-5)
    (spec,) = parts_of(path)
    assert spec.getattribute("framesPerSecond") == rate
    packed = spec.getattribute("smpte:TimeCode")[0]
    # Binary-coded decimals: tens of hours, minutes, seconds and frames have two or three bits.
    fields = ((24, 3), (16, 7), (8, 7), (0, 3))
    digits = (10 * (packed >> shift + 4 & tens) + (packed >> shift & 15) for shift, tens in fields)
    assert tuple(digits) == code


def test_the_header_tells_shutter_and_exposure(take, small, tmp_path):
    sharp = flat_picture(torch.ones(3), torch.tensor(1.0), small)
    (path,) = write(tmp_path / "sharp", sharp, layers=("rgba",))
    header = header_of(path)
    assert header["dsar/shutter"] == "0 0"
    assert "expTime" not in header
    assert "shutterAngle" not in header
    blurred = take(aovs=("rgba",), motion_samples=2, shutter=(-0.25, 0.25), fps=24.0)
    (path,) = write(tmp_path / "blurred", blurred, layers=("rgba",))
    (spec,) = parts_of(path)
    assert spec["shutterAngle"] == pytest.approx(180.0)
    assert header_of(path)["expTime"] == pytest.approx(0.5 / 24)
    assert spec["dsar/shutter"] == "-0.25 0.25"


def test_the_header_tells_the_lens(cameras, tmp_path):
    for camera in cameras:
        (path,) = write(tmp_path, flat_picture(torch.ones(3), torch.tensor(1.0), camera), layers=("rgba",))
        (spec,) = parts_of(path)
        width, height = spec["sensorOverallDimensions"]
        focal = spec["pinholeFocalLength"]
        assert width == 36
        assert focal / width * camera.width == pytest.approx(float(camera.K[0, 0]))
        assert focal / height * camera.height == pytest.approx(float(camera.K[1, 1]))


def test_every_part_says_where_it_comes_from(picture, side, tmp_path):
    paths = write(tmp_path, picture, side, views="multipart", compression="dwaa")
    for path in paths:
        for part in range(len(parts_of(path))):
            header = header_of(path, part)
            assert {key: header[f"dsar/{key}"] for key in PROVENANCE} == PROVENANCE
            assert header["cameraLabel"] == header["view"]
            assert header["dsar/job"] == f"job of {header['view']}"
            assert header["software"] == "dsar 0.1"
