"""Several cameras in files of their own, or in one."""

import dataclasses

import numpy as np
import pytest
from exr_files import (
    attributes,
    bits,
    channels_of,
    header_of,
    parts_of,
    write,
)

from dsar.errors import ExportError
from dsar_exporters import ExrSequence


def test_a_file_of_one_view_says_so_in_both_ways(picture, side, tmp_path):
    for path in write(tmp_path, picture, side):
        camera = path.parent.name
        assert attributes(path) == [(camera, [camera])]


@pytest.mark.parametrize("compression", ["zips", "dwaa"])
def test_parts_have_a_view_each_and_no_list_of_views(picture, side, tmp_path, compression):
    path, *_ = write(tmp_path, picture, side, views="multipart", compression=compression)
    each = 1 if compression == "zips" else 2
    assert attributes(path) == [("front", None)] * each + [("side", None)] * each
    specs = parts_of(path)
    names = [spec["oiio:subimagename"] for spec in specs]
    assert len(set(names)) == len(names) == 2 * each
    # What OpenEXR wants all parts of a file to agree on.
    for key in ("displayWindow", "pixelAspectRatio", "timeCode", "chromaticities"):
        assert len({str(header_of(path, part)[key]) for part in range(len(specs))}) == 1
    found = channels_of(path)
    for view in (picture, side):
        (prefix,) = (name for name in names if name.endswith(view.camera.name) and "data" not in name)
        alpha = found[f"{prefix}/A"].astype(np.float32)
        assert np.abs(alpha - view.output.alpha.numpy()).max() < (1e-3 if each == 1 else 0.02)
        data = prefix.replace("rgba.", "data.")
        assert bits(found[f"{data}/Z"]) == bits(view.output.depth.numpy())
    # No channel names a view: that is what the parts are for.
    assert not any("front." in name and "front.Z" not in name for name in specs[0].channelnames)


def test_a_lossy_file_of_one_view_has_two_parts_of_that_view(picture, tmp_path):
    path, _ = write(tmp_path, picture, compression="dwaa")
    assert attributes(path) == [("front", None), ("front", None)]


def test_views_of_different_sizes_do_not_go_into_one_file(front, tmp_path):
    views = [front, dataclasses.replace(front.resized(96, 128), name="small")]
    with pytest.raises(ExportError, match=r"cameras of one size, found \[\(96, 128\), \(192, 256\)\]"):
        ExrSequence(tmp_path, views="multipart").check(views)
    ExrSequence(tmp_path, views="separate").check(views)
    ExrSequence(tmp_path, views="multipart").check(views[:1])
