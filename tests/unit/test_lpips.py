import io
import pickle

import pytest
import torch

from dsar.errors import ConfigError, DsarError
from dsar.metrics.lpips import Lpips, find_lpips_weights, load_lpips
from tools.fetch_lpips import ArrayUnpickler, convert_checkpoint

NETS = ("alex", "vgg")


def make_random_lpips(net, seed=0):
    """A network with random weights and positive heads: what must hold whatever LPIPS has learned."""
    model = Lpips(net)
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        if parameter.dim() == 4:
            fan_in = parameter[0].numel()
            parameter.normal_(0, (2 / fan_in) ** 0.5, generator=generator)
        else:
            parameter.uniform_(0, 0.1, generator=generator)
    return model


def make_waves(height=64, width=80):
    """Two images by formula, so that every implementation can make them."""
    y, x = torch.meshgrid(torch.arange(height) / 64, torch.arange(width) / 64, indexing="ij")
    first = torch.stack([(7 * x + 3 * y).sin(), (5 * y).cos(), (11 * x * y).sin()]) / 2 + 0.5
    return first[None], (first + 0.2 * (29 * x - 17 * y).sin()).clamp(0, 1)[None]


@pytest.mark.parametrize("net", NETS)
def test_distance_of_an_image_to_itself_is_zero(net):
    first, _ = make_waves()
    assert make_random_lpips(net)(first, first).item() == 0


@pytest.mark.parametrize("net", NETS)
def test_distance_is_symmetric(net):
    first, second = make_waves()
    model = make_random_lpips(net)
    torch.testing.assert_close(model(first, second), model(second, first), rtol=1e-6, atol=0)


@pytest.mark.parametrize("net", NETS)
def test_distance_grows_with_noise(net):
    first, _ = make_waves()
    noise = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
    model = make_random_lpips(net)
    distances = [model(first, first + sigma * noise).item() for sigma in (0.01, 0.03, 0.1, 0.3)]
    assert distances == sorted(distances)
    assert distances[0] > 0


@pytest.mark.parametrize("net", NETS)
def test_each_pair_of_a_batch_is_measured_alone(net):
    first, second = make_waves()
    model = make_random_lpips(net)
    batch = model(torch.cat([first, second]), torch.cat([second, second]))
    torch.testing.assert_close(batch, torch.stack([model(first, second)[0], torch.tensor(0.0)]))


@pytest.mark.parametrize("net", NETS)
def test_gradient_is_finite_where_all_features_are_zero(net):
    model = make_random_lpips(net)
    for name, parameter in model.named_parameters():
        if name.endswith("bias"):
            parameter.fill_(-1e3)
    first, second = (image.requires_grad_() for image in make_waves())
    model(first, second).sum().backward()
    assert first.grad is not None
    assert first.grad.isfinite().all()


def test_only_the_images_receive_gradients():
    first, second = make_waves()
    model = make_random_lpips("alex")
    model(first.requires_grad_(), second).sum().backward()
    assert first.grad is not None
    assert first.grad.count_nonzero() > 0
    assert all(parameter.grad is None for parameter in model.parameters())


# What the reference implementation (PyPI lpips 0.1.4, its own linear heads) says of make_waves(); the two
# agreed to 1e-8 on random images, so 1e-5 leaves room for another machine's convolutions only.
@pytest.mark.parametrize(("net", "expected"), [("alex", 0.193118), ("vgg", 0.324928)])
def test_trained_distance_equals_the_reference_implementation(net, expected):
    if not find_lpips_weights(net).exists():
        pytest.skip(f"no LPIPS weights at {find_lpips_weights(net)}: run python tools/fetch_lpips.py")
    assert load_lpips(net)(*make_waves()).item() == pytest.approx(expected, abs=1e-5)


def test_missing_weights_name_the_command_that_fetches_them(tmp_path, monkeypatch):
    monkeypatch.setenv("DSAR_CACHE", str(tmp_path))
    with pytest.raises(ConfigError, match=r"lpips_vgg\.safetensors.*python tools/fetch_lpips\.py"):
        load_lpips("vgg")


def test_damaged_weights_are_told_by_their_file(tmp_path, monkeypatch):
    monkeypatch.setenv("DSAR_CACHE", str(tmp_path))
    for contents in (b"", b"<html>", bytes(2000)):
        find_lpips_weights("alex").write_bytes(contents)
        with pytest.raises(ConfigError, match=r"lpips_alex\.safetensors is cut or holds something else"):
            load_lpips("alex")


@pytest.mark.parametrize("net", NETS)
def test_converted_checkpoint_holds_the_same_network(net):
    model = make_random_lpips(net)
    tensors = [tensor for name, tensor in model.named_parameters() if name.startswith("stages")]
    checkpoint = {
        "AlexNet_0" if net == "alex" else "VGG16_0": {
            f"Conv_{i}": {"kernel": weight.permute(2, 3, 1, 0).numpy(), "bias": bias.numpy()}
            for i, (weight, bias) in enumerate(zip(tensors[::2], tensors[1::2], strict=True))
        },
        **{
            f"NetLinLayer_{i}": {"Conv_0": {"kernel": head[None, None, :, None].numpy()}}
            for i, head in enumerate(model.heads)
        },
    }
    converted = convert_checkpoint(checkpoint, net)
    assert converted.keys() == model.state_dict().keys()
    assert all(torch.equal(converted[key], value) for key, value in model.state_dict().items())


def test_checkpoint_with_code_in_it_is_refused():
    with pytest.raises(DsarError, match="only NumPy arrays"):
        ArrayUnpickler(io.BytesIO(pickle.dumps(print))).load()
