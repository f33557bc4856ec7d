"""Captures as people have them: litter, suffixes, marks, names, rates."""

import json
import pickle
import re
import zipfile

import numpy as np
import pytest
from PIL import Image
from wild import NAMES, RANGES, reopened

from dsar.data.captures.formats import open_capture
from dsar.errors import BodyError, CaptureError


def summaries(capture):
    return [
        capture.image(sequence, frame, index)
        for sequence, motion in capture.motions.items()
        for frame in range(0, len(motion), 4)
        for index in capture.cameras_with_image(sequence, frame)
    ]


def assert_same(one, other, tolerance=0):
    assert [camera.name for camera in one.cameras] == [camera.name for camera in other.cameras]
    assert list(one.motions) == list(other.motions)
    pairs = list(zip(summaries(one), summaries(other), strict=True))
    assert len(pairs) >= 16
    for a, b in pairs:
        assert np.abs(a.astype(int) - b).max() <= tolerance


@pytest.mark.parametrize("name", NAMES)
def test_litter_beside_the_files_changes_nothing(folder, written, name):
    root = folder(name)
    for path in [path for path in root.rglob("*") if path.is_file()]:
        (path.parent / f"._{path.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    for path in [root, *(path for path in root.rglob("*") if path.is_dir())]:
        for litter in (".DS_Store", "Thumbs.db", "desktop.ini"):
            (path / litter).write_bytes(b"\0\0\0\1Bud1")
        (path / "__MACOSX").mkdir()
    assert_same(reopened(written, root, name), reopened(written, written / name, name))


@pytest.mark.parametrize("name", NAMES)
def test_files_may_have_suffixes_in_capitals(folder, written, name):
    root = folder(name)
    for path in [path for path in root.rglob("*") if path.suffix in (".png", ".jpg", ".json", ".csv")]:
        path.rename(path.with_suffix(path.suffix.upper()))
    if (root / "smpl_params.npz").exists():
        (root / "smpl_params.npz").rename(root / "SMPL_params.NPZ")
    assert_same(reopened(written, root, name), reopened(written, written / name, name))


@pytest.mark.parametrize("name", NAMES[:4])
def test_images_may_be_png_where_jpg_is_usual_and_the_other_way_round(folder, written, name):
    root = folder(name)
    for path in [*root.rglob("*.jpg")]:
        Image.open(path).save(path.with_suffix(".png"))
        path.unlink()
    for path in [*root.rglob("*mask*.png")] if name in ("actorshq", "dress") else ():
        Image.open(path).save(path.with_suffix(".jpeg"), quality=100)
        path.unlink()
    tolerance = 3 if name in ("actorshq", "dress") else 0
    assert_same(reopened(written, root, name), reopened(written, written / name, name), tolerance)


@pytest.mark.parametrize("name", ["avatarrex", "thuman4", "actorshq", "native"])
def test_text_may_have_a_byte_order_mark_and_the_line_ends_of_windows(folder, written, name):
    root = folder(name)
    for path in [*root.rglob("*.json"), *root.rglob("*.csv"), *root.glob("missing*")]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    assert_same(reopened(written, root, name), reopened(written, written / name, name))


def test_folders_and_cameras_may_have_spaces_and_other_letters(folder, written):
    root = folder("avatarrex")
    record, new = json.loads((root / "calibration_full.json").read_text()), {}
    for name, letters in zip(list(record), ("Kamera 1", "links oben", "右", "Größe"), strict=True):
        new[letters] = record[name]
        (root / name).rename(root / letters)
    (root / "calibration_full.json").write_text(json.dumps(new, ensure_ascii=False), encoding="utf-8")
    root = root.rename(root.parent / "Aufnahme 1 (März)")
    capture = reopened(written, root, "avatarrex")
    assert [camera.name for camera in capture.cameras] == ["Kamera_1", "links_oben", "u53f3", "Gru00f6u00dfe"]
    for one, other in zip(
        summaries(capture), summaries(reopened(written, written / "avatarrex", "avatarrex")), strict=True
    ):
        assert np.array_equal(one, other)


def test_archives_may_have_a_folder_on_top_and_litter(folder, written):
    root = folder("native")
    record = json.loads((root / "capture.json").read_text())
    for name, entry in record["sequences"].items():
        with zipfile.ZipFile(root / f"{name}.zip", "w") as archive:
            for path in (root / entry["images"]).glob("*/*"):
                place = f"export/{name}/{path.parent.name}/{path.stem}"
                archive.write(path, f"{place}.PNG")
                archive.writestr(f"__MACOSX/{path.parent.name}/._{path.name}", b"\0\5\x16\7")
        entry["images"] = f"{name}.zip"
    (root / "capture.json").write_text(json.dumps(record))
    assert_same(reopened(written, root, "native"), reopened(written, written / "native", "native"))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("sequences", "sway", "images"), "../../etc", "expected a path inside .*found '../../etc'"),
        (("sequences", "sway", "images"), "/etc", "expected a path inside"),
        (("sequences", "sway", "motion"), "../sway.npz", "expected a path inside"),
        (("sequences", "sway", "garment"), "/tmp/x.npz", "expected a path inside"),
        (("body",), "../body.npz", "expected a path inside"),
        (("sequences", "../sway"), {}, "expected a name that can be a file's, found '../sway'"),
        (("fps",), float("nan"), "expected 'fps' as a number above 0, found nan"),
        (("fps",), True, "expected 'fps' as int or float, found True"),
        (("betas",), [float("nan")], "expected 'betas' as a list of finite numbers"),
        (("cameras", 0, "K", 0, 0), float("nan"), "expected K as a 3x3 list of finite numbers"),
        (("sequences", "sway", "frames"), float("inf"), "expected 'frames' as int, found inf"),
    ],
)
def test_a_record_that_leads_elsewhere_or_is_not_finite_is_refused(folder, path, value, message):
    root = folder("native")
    record = json.loads((root / "capture.json").read_text())
    target = record
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    (root / "capture.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match=message):
        open_capture(root)


def test_cameras_and_frames_that_lead_elsewhere_are_refused(folder, written):
    root = folder("thuman4")
    record = json.loads((root / "calibration.json").read_text())
    (root / "calibration.json").write_text(
        json.dumps({f"../{name}": entry for name, entry in record.items()})
    )
    with pytest.raises(CaptureError, match=r"name that can be a file's, found '\.\./cam00'"):
        reopened(written, root, "thuman4")
    root = folder("dress")
    info = pickle.loads((root / "Take1/basic_info.pkl").read_bytes())
    (root / "Take1/basic_info.pkl").write_bytes(pickle.dumps(info | {"scan_frames": ["../../x"]}))
    with pytest.raises(CaptureError, match=r"basic_info\.pkl: expected a name"):
        reopened(written, root, "dress")


def set_rates(root, rate, filed):
    record = json.loads((root / "capture.json").read_text()) | {"fps": rate}
    (root / "capture.json").write_text(json.dumps(record))
    for path in (root / "motion").glob("*.npz"):
        with np.load(path) as file:
            np.savez(path, **(dict(file) | {"mocap_frame_rate": np.array(filed)}))


@pytest.mark.parametrize(
    ("rate", "filed"),
    [
        (29.97, 30000 / 1001),
        (30000 / 1001, np.float32(29.97)),
        (23.976, 24000 / 1001),
        (59.94, np.float32(60000 / 1001)),
        (25, 25.0),
    ],
)
def test_a_rate_in_other_digits_is_the_same_rate(folder, rate, filed):
    root = folder("native")
    set_rates(root, rate, filed)
    capture = open_capture(root)
    assert {motion.fps for motion in capture.motions.values()} == {capture.fps} == {rate}


@pytest.mark.parametrize(
    ("rate", "filed"), [(23.976, 24.0), (30.0, 30000 / 1001), (29.97, 29.98), (25.0, 50.0)]
)
def test_another_rate_is_refused_in_numbers_that_differ(folder, rate, filed):
    root = folder("native")
    set_rates(root, rate, filed)
    with pytest.raises(
        CaptureError, match=r"expected \d+ frames at (\S+) a second, found \d+ at (\S+) in"
    ) as caught:
        open_capture(root)
    numbers = re.search(r"frames at (\S+) a second, found \d+ at (\S+) in", str(caught.value)).groups()
    assert numbers[0] != numbers[1]


def test_a_body_variable_that_names_nothing_is_said_to(written, monkeypatch, tmp_path):
    monkeypatch.setenv("DSAR_BODY", str(tmp_path / "none.npz"))
    with pytest.raises(BodyError, match=r"\$DSAR_BODY is '.*none\.npz': no such file or folder"):
        open_capture(written / "avatarrex", **RANGES)
    monkeypatch.setenv("HOME", str(written))
    monkeypatch.setenv("DSAR_BODY", "~/body.npz")
    assert open_capture("~/avatarrex", **RANGES).body_path == written / "body.npz"
