"""Images from disk: decoding, the bounded cache."""

import threading

import numpy as np
import pytest
import torch
from PIL import Image

from dsar.data.images.decoding import ImageCache
from dsar.data.images.photos import Photos
from dsar.types import Camera

CAMERA = Camera(torch.eye(3), torch.eye(4), 6, 4, "cam")


def save(path, pixels):
    Image.fromarray(pixels).save(path)
    return path


def decode_photo(color, mask, camera):
    """Return what a take of one photograph gives."""
    views = Photos(color.parent, color.name, mask.name, (0,), {camera.name: camera.name})
    return views.read(camera, 0)


def test_a_photograph_gets_its_mask_as_alpha(tmp_path):
    rng = np.random.default_rng(0)
    color, mask = (rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((4, 6, 3), (4, 6)))
    found = decode_photo(save(tmp_path / "c.png", color), save(tmp_path / "m.png", mask), CAMERA)
    assert np.array_equal(found, np.dstack([color, mask]))
    colored = save(tmp_path / "m3.png", np.dstack([mask] * 3))
    assert np.array_equal(decode_photo(tmp_path / "c.png", colored, CAMERA), found)
    binary = save(tmp_path / "m1.png", mask > 127)
    assert np.array_equal(decode_photo(tmp_path / "c.png", binary, CAMERA)[..., 3], 255 * (mask > 127))
    Image.fromarray(mask).convert("P").save(tmp_path / "p.png")
    assert np.array_equal(decode_photo(tmp_path / "c.png", tmp_path / "p.png", CAMERA)[..., 3], mask)
    grey = save(tmp_path / "g.png", color[..., 0])
    assert np.array_equal(decode_photo(grey, tmp_path / "m.png", CAMERA)[..., 2], color[..., 0])


def test_the_cache_keeps_what_was_used_last_and_never_more_than_it_has_room_for():
    cache, made = ImageCache(capacity=1000), []

    def image(key):
        def make():
            made.append(key)
            return np.full(300, key, np.uint8)

        return cache.get(key, make)

    for key in (1, 2, 3, 1, 4, 1, 2):
        assert image(key)[0] == key
        assert cache.used <= 1000
    # 4 pushed out 2, which had not been asked for since, and 1 stayed.
    assert made == [1, 2, 3, 4, 2]
    assert cache.get("large", lambda: np.zeros(2000, np.uint8)).size == 2000
    assert cache.used <= 1000
    with pytest.raises(ValueError, match="read-only"):
        image(1)[0] = 0


def test_threads_may_share_a_cache():
    cache = ImageCache(capacity=5000)

    def work(seed):
        for key in np.random.default_rng(seed).integers(0, 30, 500).tolist():
            assert cache.get(key, lambda key=key: np.full(300, key, np.uint8))[0] == key

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cache.used == 300 * len(cache._images) <= 5000
