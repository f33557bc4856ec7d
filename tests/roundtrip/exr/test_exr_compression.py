"""What compression may change, and what it may not."""

import numpy as np
import pytest
from exr_files import (
    HALF,
    bits,
    channels_of,
    parts_of,
    types_of,
    write,
)

LOSSLESS = ("none", "rle", "zips", "zip", "piz")
LOSSY = ("pxr24", "b44", "b44a", "dwaa", "dwab")


@pytest.mark.parametrize("compression", LOSSLESS)
def test_lossless_compressions_hold_the_same_pixels(picture, tmp_path, compression):
    usual = channels_of(write(tmp_path / "zips", picture)[0])
    path, deep = write(tmp_path / "other", picture, compression=compression)
    (spec,) = parts_of(path)
    assert spec["compression"] == compression
    found = channels_of(path)
    assert found.keys() == usual.keys()
    assert all(bits(found[name]) == bits(values) for name, values in usual.items())
    assert parts_of(deep)[0]["compression"] == "zips"


@pytest.mark.parametrize("compression", LOSSY)
def test_lossy_compressions_touch_colours_only(picture, tmp_path, compression):
    usual = channels_of(write(tmp_path / "zips", picture)[0])
    path, _ = write(tmp_path / "lossy", picture, compression=compression)
    color, data = parts_of(path)
    assert (color["compression"], data["compression"]) == (compression, "zips")
    assert types_of(color) == HALF
    found = channels_of(path)
    exact = {name: values for name, values in usual.items() if name not in HALF}
    assert set(types_of(data)) == set(exact)
    for name, values in exact.items():
        assert bits(found[f"data.front/{name}"]) == bits(values), name
    for name in HALF:
        difference = found[f"rgba.front/{name}"].astype(np.float32) - usual[name].astype(np.float32)
        assert np.abs(difference).mean() < 1e-3, name
    assert any(bits(found[f"rgba.front/{name}"]) != bits(usual[name]) for name in HALF) or (
        compression == "pxr24"  # which keeps half floats
    )


@pytest.mark.parametrize("layers", [("Z", "id", "crypto"), ("motion",)])
def test_data_alone_is_lossless_whatever_is_asked_for(picture, tmp_path, layers):
    usual, lossy = (
        write(tmp_path / kind, picture, layers=layers, compression=kind)[0] for kind in ("zips", "dwaa")
    )
    assert [spec["compression"] for spec in parts_of(lossy)] == ["zips"]
    expected, found = channels_of(usual), channels_of(lossy)
    assert all(bits(found[name]) == bits(values) for name, values in expected.items())
