"""Whatever happens to a file of a capture: it is read, or one error names the file; nothing else."""

import shutil

import layouts
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dsar.body.files import EMBEDDED_BODY
from dsar.data.captures.formats import open_capture
from dsar.errors import DsarError

RANGES = {"train_frames": "0-1", "test_frames": "2-3"}
RECORDS = (
    *("capture.json", "calibration.json", "calibration_full.json", "calibration.csv"),
    *("basic_info.pkl", "cameras.pkl", "missing_img_files.txt", "missing_msk_files.txt"),
)
NAMES = ("native", "avatarrex", "thuman4", "actorshq", "dress")


@pytest.fixture(scope="module")
def layouts_folder(tiny_capture, tmp_path_factory):
    """Four frames of two cameras in every layout."""
    folder = tmp_path_factory.mktemp("sound")
    capture = open_capture(tiny_capture, train_frames="0-3").with_cameras(2)
    layouts.write_avatarrex(capture, "turn", folder / "avatarrex")
    layouts.write_thuman4(capture, "turn", folder / "thuman4")
    layouts.write_actorshq(capture, "turn", folder / "actorshq")
    hands = layouts.body_with_hands(folder / "body.npz")
    layouts.write_dress(capture, ["turn", "sway"], folder / "dress", hands=hands, scans=True)
    shutil.copytree(tiny_capture, folder / "native")
    return folder


def spoil(path, kind, where, data):
    content = path.read_bytes()
    place = int(where * len(content))
    if kind == "cut":
        path.write_bytes(content[:place])
    elif kind == "flip":
        flipped = bytes(a ^ b for a, b in zip(content[place:], data, strict=False))
        path.write_bytes(content[:place] + flipped + content[place + len(flipped) :])
    elif kind == "insert":
        path.write_bytes(content[:place] + data + content[place:])
    elif kind == "replace":
        path.write_bytes(data)
    else:
        path.unlink()


def read_all(root, name):
    body = root.parent / "body.npz" if name == "dress" else None if name == "native" else EMBEDDED_BODY
    capture = open_capture(root, body=body, **({} if name in ("dress", "native") else RANGES))
    for sequence, motion in capture.motions.items():
        assert np.isfinite(motion.rotations.numpy()).all()
        for frame in range(0, len(motion), 2):
            for camera in capture.cameras_with_image(sequence, frame)[:3]:
                assert capture.image(sequence, frame, camera).shape[2] == 4


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    name=st.sampled_from(NAMES),
    pick=st.floats(0, 1, exclude_max=True),
    kind=st.sampled_from(("cut", "flip", "insert", "replace", "delete")),
    where=st.floats(0, 1, exclude_max=True),
    data=st.binary(min_size=1, max_size=40),
)
def test_a_corrupted_file_is_read_or_refused_by_name(layouts_folder, name, pick, kind, where, data):
    root = layouts_folder / name
    files = sorted(path for path in root.rglob("*") if path.is_file())
    # Images are most of the files: half of the draws go to the others.
    others = [path for path in files if path.suffix not in (".png", ".jpg")]
    path = (others if pick < 0.5 else files)[int(2 * pick % 1 * len(others if pick < 0.5 else files))]
    kept, message = path.read_bytes(), None
    try:
        spoil(path, kind, where, data)
        read_all(root, name)
    except DsarError as error:
        message = str(error)
    finally:
        path.write_bytes(kept)
    # A damaged record may name other files than it did.
    assert message is None or path.name in message or (str(root) in message and path.name in RECORDS)
