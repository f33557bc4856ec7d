"""Captures as people have them: litter, suffixes, marks, names; and one reason for a file everywhere."""

import json
import pickle
import re
import shutil
import zipfile

import conftest
import layouts
import numpy as np
import pytest
from PIL import Image, ImageOps

from dsar.body.files import EMBEDDED_BODY
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.errors import BodyError, CaptureError
from dsar.evaluation.check import image_summaries
from dsar.evaluation.check.image_findings import find_color_faults, find_mask_faults
from dsar.evaluation.check.mask_alignment import find_misaligned_masks
from dsar.evaluation.check.quick_check import refuse_unusable_images

RANGES = {"train_frames": "0-7", "test_frames": "9-13"}
NAMES = ("avatarrex", "thuman4", "actorshq", "dress", "native")


@pytest.fixture(scope="module")
def written(tiny_capture, tmp_path_factory):
    """A folder of each layout."""
    folder, original = tmp_path_factory.mktemp("wild"), open_capture(tiny_capture)
    for name in NAMES[:3]:
        getattr(layouts, f"write_{name}")(original, "turn", folder / name)
    hands = layouts.body_with_hands(folder / "body.npz")
    layouts.write_dress(original, ["turn", "sway"], folder / "dress", hands=hands)
    shutil.copytree(tiny_capture, folder / "native")
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to spoil, by layout."""
    return lambda name: shutil.copytree(written / name, tmp_path / name)


def reopened(written, root, name):
    body = {"dress": written / "body.npz", "native": None}.get(name, EMBEDDED_BODY)
    return open_capture(root, body=body, **({} if name in ("dress", "native") else RANGES))


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


def spoil(root, pattern, change):
    for path in sorted(root.glob(pattern)):
        with Image.open(path) as image:
            image.load()
        change(path, image)


def cut_short(path, _):
    if path.stem != "00000000":
        path.write_bytes(path.read_bytes()[:400])


SPOILT = {
    "inks": ("*/*.jpg", lambda path, image: image.convert("CMYK").save(path), r"CMYK"),
    "parts": ("*/mask/pha/*.jpg", lambda path, image: image.point(lambda v: v // 9).save(path), "no mask"),
    "half": ("*/*.jpg", lambda path, image: image.resize((24, 32)).save(path), r"0\.5 times the size"),
    "page": ("*/mask/pha/*.jpg", lambda path, _: path.write_text("<html>"), "a web page"),
    "cut": ("*/*.jpg", cut_short, "cannot be decoded"),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILT)
def test_check_and_train_give_the_same_reason_for_the_same_file(folder, tmp_path, capsys, name):
    root = folder("avatarrex")
    pattern, change, reason = SPOILT[name]
    spoil(root, pattern, change)
    common = ["--body", str(EMBEDDED_BODY), "--train-frames", "1-8", "--test-frames", "10-13"]
    said = []
    for arguments in (
        ["check", str(root), *common, "--sheet", str(tmp_path / "s.png"), "--progress", "none"],
        conftest.train_arguments(root, tmp_path / "run", *common, "--steps", "2", "--workers", "1"),
    ):
        with pytest.raises(SystemExit) as left:
            main(arguments)
        assert left.value.code == 2
        found = capsys.readouterr()
        said += re.findall(r"(?:image|mask) \S+?/\d+\.jpg: .*", found.out + found.err)[-1:]
    assert len(said) == 2
    # They may meet another image first.
    one, other = (re.sub(r"/\d{8}/\S*?\d+\.jpg", "", line) for line in said)
    assert one == other
    assert re.search(reason, one)


def judged(capture):
    """Return the names and words of what is wrong with masks and photographs."""
    found = list(image_summaries.summarize_images(capture))
    assert not [summary.broken for summary in found if summary.broken]
    usable = {(p.sequence, p.frame, p.camera) for p in found if p.coverage > 0 and not p.full}
    return {
        each.name: each
        for each in (*find_mask_faults(capture, found), *find_color_faults(capture, found, usable))
    }


@pytest.mark.parametrize("name", NAMES)
def test_clean_captures_have_masks_and_photographs_that_fit(written, name):
    assert judged(reopened(written, written / name, name)) == {}


TURNS = {
    "turned by 180 degrees": lambda image: image.transpose(Image.Transpose.ROTATE_180),
    "mirrored left to right": lambda image: image.transpose(Image.Transpose.FLIP_LEFT_RIGHT),
    "mirrored top to bottom": lambda image: image.transpose(Image.Transpose.FLIP_TOP_BOTTOM),
}


@pytest.mark.parametrize("how", TURNS)
def test_photographs_that_are_turned_against_their_masks_are_named_with_their_cameras(folder, written, how):
    root = folder("avatarrex")
    spoil(root, f"{layouts.SERIALS[2]}/*.jpg", lambda path, image: TURNS[how](image).save(path, quality=95))
    capture = reopened(written, root, "avatarrex")
    found = judged(capture)
    assert list(found) == ["photographs_turned"]
    assert found["photographs_turned"].fatal
    assert f"photographs of cam_{layouts.SERIALS[2]} are {how} against" in found["photographs_turned"].what
    usable = {(name, frame, 2) for name, motion in capture.motions.items() for frame in range(len(motion))}
    (misfit,) = find_misaligned_masks(capture, usable)
    assert misfit.after > misfit.before + 0.1


def test_exif_that_shows_a_photograph_upright_is_right_and_one_that_does_not_is_found(folder, written):
    exif = Image.Exif()
    exif[0x112] = 3
    root = folder("avatarrex")
    spoil(
        root,
        "*/*.jpg",
        lambda path, image: image.rotate(180).save(path, exif=exif, quality=100, subsampling=0),
    )
    assert judged(reopened(written, root, "avatarrex")) == {}
    spoil(
        root,
        "*/*.jpg",
        lambda path, image: image.rotate(180).save(path, exif=exif, quality=100, subsampling=0),
    )
    shutil.copytree(root, root.parent / "again")
    assert list(judged(reopened(written, root.parent / "again", "avatarrex"))) == ["photographs_turned"]


def save_alpha(path, image):
    Image.merge("RGBA", [Image.new("L", image.size, 255)] * 3 + [image]).save(path)


MASKS = {
    "zero and one": (lambda path, image: image.point(lambda v: v > 127 and 1).save(path), {}),
    "alpha": (save_alpha, {}),
    "inverted": (lambda path, image: image.point(lambda v: 255 - v).save(path), {"masks_inverted": True}),
    "full": (lambda path, image: Image.new("L", image.size, 255).save(path), {"full_masks": True}),
    "full alpha": (
        lambda path, image: Image.new("RGBA", image.size, (0, 0, 0, 0)).save(path),
        {"empty_masks": True},
    ),
    "empty": (lambda path, image: Image.new("L", image.size, 0).save(path), {"empty_masks": True}),
    "one empty": (
        lambda path, image: Image.new("L", image.size, 0).save(path) if path.stem.endswith("03") else None,
        {"empty_masks": False},
    ),
    "one faint": (
        lambda path, image: image.point(lambda v: v // 3).save(path) if path.stem.endswith("03") else None,
        {"faint_masks": False},
    ),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_are_told_what_is_really_wrong_with_them(folder, written, name):
    root = folder("actorshq")
    change, expected = MASKS[name]
    spoil(root, "4x/masks/*/*.png", change)
    found = judged(reopened(written, root, "actorshq"))
    assert {key: finding.fatal for key, finding in found.items()} == expected
    if name == "one empty":
        assert "4 of 52 masks (the first: actorshq_train, frame 3, Cam001) are 0 in every pixel" in (
            found["empty_masks"].what
        )


def test_a_camera_that_is_grey_or_dark_beside_the_others_is_named(folder, written):
    root = folder("avatarrex")
    spoil(root, f"{layouts.SERIALS[1]}/*.jpg", lambda path, image: image.convert("L").save(path))
    spoil(root, f"{layouts.SERIALS[3]}/*.jpg", lambda path, image: image.point(lambda v: v // 4).save(path))
    found = judged(reopened(written, root, "avatarrex"))
    assert set(found) == {"grey_cameras", "camera_exposure"}
    assert f"images of cam_{layouts.SERIALS[1]} are grey" in found["grey_cameras"].what
    assert f"cam_{layouts.SERIALS[3]} shows the person" in found["camera_exposure"].what
    assert not any(finding.fatal for finding in found.values())


MASK_FILES, PHOTOGRAPH_FILES = "*/mask/pha/*.jpg", "22*/*.jpg"
UNFIT = {
    "masks_inverted": (
        MASK_FILES,
        lambda path, image: ImageOps.invert(image.convert("L")).save(path, quality=95),
    ),
    "empty_masks": (MASK_FILES, lambda path, image: Image.new("L", image.size).save(path)),
    "full_masks": (MASK_FILES, lambda path, image: Image.new("L", image.size, 255).save(path)),
    "photographs_turned": (PHOTOGRAPH_FILES, lambda path, image: image.rotate(180).save(path, quality=95)),
}


@pytest.mark.parametrize("name", UNFIT)
def test_what_check_says_cannot_train_is_refused_before_training_in_its_words(folder, tmp_path, capsys, name):
    root = folder("avatarrex")
    spoil(root, *UNFIT[name])
    common = ["--body", str(EMBEDDED_BODY), "--train-frames", "0-8", "--test-frames", "10-13"]
    with pytest.raises(SystemExit) as left:
        main(["check", str(root), *common, "--sheet", str(tmp_path / "s.png"), "--progress", "none"])
    assert left.value.code == 2
    assert f"CANNOT TRAIN {name}: " in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        main(conftest.train_arguments(root, tmp_path / "run", *common, "--steps", "2", "--workers", "1"))
    assert left.value.code == 2
    assert f"cannot train: {name}: " in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", NAMES)
def test_clean_captures_pass_at_a_glance(written, name):
    refuse_unusable_images(reopened(written, written / name, name))
