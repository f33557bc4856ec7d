"""What the numbers of a camera's masks mean is found from several of them, and said once."""

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.data.images.conversions import ConversionLog
from dsar.data.images.photos import Photos
from dsar.errors import CaptureError
from dsar.types import Camera

H, W, FRAMES = 6, 8, 7
CAMERA = Camera(torch.eye(3), torch.eye(4), W, H, "cam")
PERSON = np.zeros((FRAMES, H, W), np.uint8)
for _frame in range(FRAMES):
    PERSON[_frame, 1:5, 1 : 3 + _frame % 5] = 1


def take(folder, masks):
    """Return a take of one camera with these masks, and photographs of one colour."""
    for frame, mask in enumerate(masks):
        Image.new("RGB", (W, H), (9, 99, 199)).save(folder / f"c{frame}.png")
        Image.fromarray(mask).save(folder / f"m{frame}.png")
    views = Photos(
        folder,
        "c{frame}.png",
        "m{frame}.png",
        range(len(masks)),
        {"cam": "cam"},
        conversions=ConversionLog("take"),
    )
    views.check_samples([CAMERA])
    return views


def coverage(views):
    return np.stack([views.read(CAMERA, frame)[..., 3] for frame in range(len(views.frames))])


SOFT = np.random.default_rng(0).integers(0, 256, PERSON.shape, dtype=np.uint8)
CODED = {
    "0 and 1": (PERSON, 255 * PERSON, "are of 0 and 1 alone: 1 is the person"),
    "0 and 128": (128 * PERSON, 255 * PERSON, "are of 0 and 128 alone: 128 is the person"),
    "0 and 15": (15 * PERSON, 255 * PERSON, "are of 0 and 15 alone: 15 is the person"),
    "0 and 255": (255 * PERSON, 255 * PERSON, None),
    "trimaps": (np.minimum(255, 128 * (SOFT % 3).astype(int)).astype(np.uint8), None, None),
    "soft": (SOFT, SOFT, None),
    "half covered": (SOFT // 2 + 20, SOFT // 2 + 20, None),
    "16 bits": (SOFT.astype(np.uint16) * 257, SOFT, "have 16 bits"),
    "0 and 65535": (PERSON * np.uint16(65535), 255 * PERSON, "have 16 bits"),
    "16 bits, 0 and 1": (PERSON.astype(np.uint16), 255 * PERSON, "are of 0 and 1 alone"),
    "16 bits, 0 and 255": (255 * PERSON.astype(np.uint16), 255 * PERSON, "are of 0 and 255 alone"),
    "8 soft bits in 16": (
        np.maximum(SOFT, 255 * PERSON).astype(np.uint16),
        None,
        "have 8 bits in numbers of 16",
    ),
}


@pytest.mark.parametrize("name", CODED)
def test_masks_are_read_as_what_they_are_and_it_is_said_once(tmp_path, caplog, name):
    caplog.set_level("INFO")
    masks, expected, note = CODED[name]
    found = coverage(take(tmp_path, masks))
    assert np.array_equal(found, masks if expected is None else expected)
    said = [record.message for record in caplog.records]
    assert len(said) == (note is not None)
    if note:
        assert f"Capture take: masks of 1 of 1 cameras {note}" in said[0]
        assert f"(first {tmp_path / 'm0.png'})" in said[0]


def test_masks_of_nobody_say_nothing_of_the_others(tmp_path):
    masks = PERSON.copy()
    masks[:5] = 0
    assert np.array_equal(coverage(take(tmp_path, masks)), 255 * masks)


def test_a_faint_mask_among_sound_ones_is_not_made_a_person(tmp_path):
    masks = 255 * PERSON
    masks[3] = PERSON[3]
    assert np.array_equal(coverage(take(tmp_path, masks)), masks)


def test_one_mask_that_is_written_otherwise_is_refused_by_name(tmp_path):
    masks = PERSON.copy()
    masks[1] *= 255
    views = take(tmp_path, masks)
    assert np.array_equal(views.read(CAMERA, 0)[..., 3], 255 * PERSON[0])
    with pytest.raises(
        CaptureError, match=r"m1\.png: expected 0 and 1 as in this camera's other masks, found 255"
    ):
        views.read(CAMERA, 1)


def test_parts_by_number_are_no_masks(tmp_path):
    with pytest.raises(CaptureError, match=r"m0\.png: is no mask: .*found \d+ numbers from 0 to 19"):
        take(tmp_path, SOFT % 20)


def test_masks_none_of_which_can_be_read_are_refused_when_the_take_is_opened(tmp_path):
    take(tmp_path, 255 * PERSON)
    for frame in range(FRAMES):
        (tmp_path / f"m{frame}.png").write_bytes(b"")
    views = Photos(tmp_path, "c{frame}.png", "m{frame}.png", range(FRAMES), {"cam": "cam"})
    with pytest.raises(CaptureError, match=r"m0\.png: cannot be decoded; it is empty"):
        views.check_samples([CAMERA])
    Image.fromarray(255 * PERSON[2]).save(tmp_path / "m2.png")
    Image.fromarray(255 * PERSON[3]).save(tmp_path / "m3.png")
    views.check_samples([CAMERA])
    assert np.array_equal(views.read(CAMERA, 2)[..., 3], 255 * PERSON[2])
