from collections.abc import Iterator

import pytest
import torch

from dsar.errors import ConfigError
from dsar.types import Camera, Gaussians, GaussianSequence, RenderOutput
from dsar_render import render_sequence


@pytest.fixture
def produced() -> list[int]:
    """The frames that the sequence has produced so far."""
    return []


@pytest.fixture
def sequence(produced: list[int]) -> GaussianSequence:
    """One red Gaussian that carries a gradient and moves to the right."""

    def produce() -> Iterator[Gaussians]:
        for index in range(3):
            produced.append(index)
            yield Gaussians(
                means=torch.tensor([[0.2 * index - 0.2, 0.0, 2.0]], requires_grad=True),
                rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
                scales=torch.full((1, 3), 0.05),
                opacities=torch.ones(1),
                harmonics=torch.tensor([[[1.0, -1.0, -1.0]]]),
            )

    return GaussianSequence(range(1001, 1004), 24.0, 1, produce)


def _camera(name: str) -> Camera:
    K = torch.tensor([[32.0, 0.0, 16.0], [0.0, 32.0, 12.0], [0.0, 0.0, 1.0]])
    return Camera(K, torch.eye(4), 32, 24, name)


def _column(output: RenderOutput) -> float:
    """Return the mean column of the image's coverage."""
    columns = torch.arange(output.alpha.shape[1]) + 0.5
    return float((output.alpha * columns).sum() / output.alpha.sum())


def test_every_frame_is_seen_by_every_camera_and_produced_once(sequence, produced):
    cameras = [_camera("a"), _camera("b")]
    seen = [(frame, camera.name) for frame, camera, _ in render_sequence(sequence, cameras)]
    assert seen == [(frame, name) for frame in (1001, 1002, 1003) for name in ("a", "b")]
    assert produced == [0, 1, 2]


def test_frames_are_produced_as_they_are_asked_for(sequence, produced):
    images = render_sequence(sequence, [_camera("a"), _camera("b")])
    assert produced == []
    next(images)
    next(images)
    assert produced == [0]


def test_images_follow_the_gaussian_and_carry_no_gradient(sequence):
    outputs = [output for _, _, output in render_sequence(sequence, [_camera("a")])]
    # Focal length 32 at 2 m: 0.2 m are 3.2 pixels.
    assert [_column(output) for output in outputs] == pytest.approx([12.8, 16.0, 19.2], abs=0.2)
    assert not any(output.color.requires_grad for output in outputs)


def test_the_caller_keeps_its_gradients_between_images(sequence):
    for _ in render_sequence(sequence, [_camera("a")]):
        assert torch.is_grad_enabled()


def test_a_background_shows_where_nothing_covers_it(sequence):
    background = torch.tensor([0.1, 0.2, 0.3])
    _, _, output = next(render_sequence(sequence, [_camera("a")], background=background))
    torch.testing.assert_close(output.color[0, -1], background)


@pytest.mark.parametrize(
    ("names", "message"),
    [([], "expected at least one camera"), (["a", "b", "a"], r"found \['a'\] twice")],
    ids=["none", "one name twice"],
)
def test_unusable_cameras_are_refused_before_any_frame(sequence, produced, names, message):
    with pytest.raises(ConfigError, match=message):
        render_sequence(sequence, [_camera(name) for name in names])
    assert produced == []
