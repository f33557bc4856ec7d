"""Images that training keeps: packed, they say what they said, and they take no more room than is given."""

import numpy as np
import pytest

from dsar.data.captures.formats import open_capture
from dsar.metrics.images import mask_box, with_margin
from dsar.training.kept_views import KeptViews, PackedView, largest_crop


def plain_means(image, x0, y0, x1, y1, n):
    block = image[y0 * n : y1 * n, x0 * n : x1 * n].astype(np.float64) / 255
    color = block[..., :3] * block[..., 3:]
    both = np.concatenate([color, block[..., 3:]], -1).reshape(y1 - y0, n, x1 - x0, n, 4).mean((1, 3))
    return both[..., :3], both[..., 3]


def speckled_image(seed, size=(37, 29)):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (*size, 4), np.uint8)
    image[..., 3][rng.random(size) < 0.6] = 0
    return image


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", [0, 1])
def test_means_of_a_packed_view_are_those_of_its_image_in_any_window(n, seed):
    image = speckled_image(seed)
    view, (height, width) = PackedView.of_image(image), (image.shape[0] // n, image.shape[1] // n)
    for x0, y0, x1, y1 in ((0, 0, width, height), (1, 2, width - 1, height - 1), (2, 1, 3, 2)):
        expected = plain_means(image, x0, y0, x1, y1, n)
        for found, means in zip(view.premultiplied_means(x0, y0, x1, y1, n), expected, strict=True):
            assert found.shape == means.shape
            np.testing.assert_allclose(found, means, atol=1e-6)


def test_an_image_without_a_person_is_all_transparent():
    image = np.full((6, 5, 4), 255, np.uint8)
    image[..., 3] = 0
    view = PackedView.of_image(image)
    assert view.nbytes == 0
    assert view.box == (0, 0, 5, 6)
    color, alpha = view.premultiplied_means(0, 0, 5, 6, 1)
    assert not color.any()
    assert not alpha.any()


@pytest.mark.parametrize("margin", [0, 3, 100])
def test_a_box_with_a_margin_is_the_masks_box_with_that_margin(margin):
    alpha = np.zeros((40, 30), np.uint8)
    alpha[10:20, 2:7] = 9
    assert with_margin(mask_box(alpha, 0), margin, 30, 40) == mask_box(alpha, margin)


def test_a_kept_view_is_read_once_and_none_makes_room_for_another(monkeypatch):
    capture, reads = open_capture("embedded"), []
    read = type(capture).image

    def counted(self, *key):
        reads.append(key)
        return read(self, *key)

    monkeypatch.setattr(type(capture), "image", counted)
    first, second = ("walk", 3, 0), ("walk", 4, 1)
    size = KeptViews(capture).read(*first).nbytes
    assert size < capture.image(*first).nbytes / 4
    reads.clear()
    views = KeptViews(capture, capacity=size)
    kept = views.read(*first)
    assert views.read(*first) is kept
    for _ in range(2):
        views.read(*second)
    assert reads == [first, second, second]
    assert views.used == size


def test_the_largest_crop_holds_the_person_in_the_images_that_were_looked_at():
    capture = open_capture("embedded", train_frames="0-3")
    height, width = largest_crop(capture, 6)
    boxes = []
    for name in capture.splits["train"]:
        for frame in range(len(capture.motions[name])):
            for camera in capture.cameras_with_image(name, frame):
                x0, y0, x1, y1 = mask_box(capture.image(name, frame, camera)[..., 3], 6)
                boxes.append((y1 - y0, x1 - x0))
    assert 0.8 * max(h for h, _ in boxes) <= height <= max(h for h, _ in boxes)
    assert 0.6 * max(w for _, w in boxes) <= width <= max(w for _, w in boxes)
