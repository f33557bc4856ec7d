"""VMAF through ffmpeg's own filter: what equals the truth is best, and what differs more is worse."""

import numpy as np
import pytest

pytest.importorskip("imageio_ffmpeg")

from dsar.evaluation.vmaf import vmaf


@pytest.fixture(scope="module")
def film():
    generator = np.random.default_rng(0)
    picture = generator.integers(0, 256, (40, 60, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    return [np.roll(picture, 3 * frame, 1)[:241, :321] for frame in range(12)]


def test_more_noise_is_worse_and_none_is_nearly_a_hundred(film):
    generator = np.random.default_rng(1)

    def noisy(strength):
        return [np.clip(f + generator.normal(0, strength, f.shape), 0, 255).astype(np.uint8) for f in film]

    scores = [vmaf(film, film), vmaf(noisy(8), film), vmaf(noisy(30), film)]
    assert scores[0] > 95
    assert scores[0] > scores[1] > scores[2] + 5


def test_a_frozen_film_is_worse_than_a_moving_one(film):
    assert vmaf([film[0]] * len(film), film) < vmaf(film, film) - 20


def test_films_that_cannot_be_compared_are_refused(film):
    with pytest.raises(ValueError, match="cannot be compared"):
        vmaf(film[:3], film)
    with pytest.raises(ValueError, match="one size"):
        vmaf(iter([film[0], film[0][:100]]), film[:2])
    with pytest.raises(ValueError, match="none"):
        vmaf([], film)
