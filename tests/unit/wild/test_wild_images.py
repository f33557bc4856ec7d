"""Images as people have them: one reason for a file everywhere, and faults of masks and photographs."""

import re
import shutil

import conftest
import layouts
import pytest
from PIL import Image, ImageOps
from wild import NAMES, reopened

from dsar.body.files import EMBEDDED_BODY
from dsar.cli import main
from dsar.evaluation.check import image_summaries
from dsar.evaluation.check.image_findings import find_color_faults, find_mask_faults
from dsar.evaluation.check.mask_alignment import find_misaligned_masks
from dsar.evaluation.check.quick_check import refuse_unusable_images


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
