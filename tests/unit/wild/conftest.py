import shutil

import layouts
import pytest
import wild

from dsar.data.captures.formats import open_capture


@pytest.fixture(scope="module")
def written(tiny_capture, tmp_path_factory):
    """A folder of each layout."""
    folder, original = tmp_path_factory.mktemp("wild"), open_capture(tiny_capture)
    for name in wild.NAMES[:3]:
        getattr(layouts, f"write_{name}")(original, "turn", folder / name)
    hands = layouts.body_with_hands(folder / "body.npz")
    layouts.write_dress(original, ["turn", "sway"], folder / "dress", hands=hands)
    shutil.copytree(tiny_capture, folder / "native")
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to spoil, by layout."""
    return lambda name: shutil.copytree(written / name, tmp_path / name)
