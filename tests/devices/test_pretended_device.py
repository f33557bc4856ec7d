"""The pretended device computes what the host does, and refuses what CUDA would refuse."""

import copy

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from tests.devices.host_waits import HostWaitError, watch
from tests.devices.pretended_device import MixedDevicesError, PretendedTensor
from tests.devices.recorded_graphs import RecordedGraph


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def check_same(function, device, *shapes):
    """Values and gradients of a function of random tensors are the host's to the last bit, on the device."""
    host = [torch.randn(shape).requires_grad_() for shape in shapes]
    there = [tensor.detach().to(device).requires_grad_() for tensor in host]
    expected, found = function(*host), function(*there)
    assert found.device.type == device.type
    assert torch.equal(expected, found.cpu())
    weights = torch.randn(expected.shape)
    (expected * weights).sum().backward()
    (found * weights.to(device)).sum().backward()
    for one, other in zip(host, there, strict=True):
        assert (one.grad is None) == (other.grad is None)
        if one.grad is not None:
            assert other.grad.device.type == device.type
            assert torch.equal(one.grad, other.grad.cpu())


def index(x, *rows):
    return torch.tensor(rows, device=x.device)


def write_in_place(x):
    y = torch.zeros_like(x)
    y[index(x, 2, 0, 1)] = x[:3]
    y[:, 0] += 1
    y[:, 1].mul_(2)
    y.view(-1)[0] += 1
    return y * x


OPERATIONS = {
    "rows": (lambda x: x[index(x, 2, 0, 1)], (4, 3)),
    "slices": (lambda x: x[1:3, ::2], (4, 4)),
    "new axis": (lambda x: x[..., None, :2], (4, 3)),
    "index_select": (lambda x: x.index_select(0, index(x, 2, 0)), (4, 3)),
    "index_copy": (lambda x: x.index_copy(0, index(x, 2, 0, 1), x[:3] * 2), (4, 3)),
    "index_add_": (lambda x: x.new_zeros(4, 3).index_add_(0, index(x, 0, 0, 2), x), (3, 3)),
    "gather": (lambda x: x.gather(1, index(x, 2, 0, 1)[:, None]), (3, 3)),
    "scatter_reduce": (lambda x: x.new_zeros(4).scatter_reduce(0, index(x, 0, 0, 2), x, "amax"), (3,)),
    "in place": (write_in_place, (4, 3)),
    "where": (lambda x: torch.where(x > 0, x, 0.0), (4, 3)),
    "sort": (lambda x: x.sort(1).values, (4, 5)),
    "topk": (lambda x: x.topk(2, largest=False).values, (4, 5)),
    "cdist": (torch.cdist, (4, 3), (5, 3)),
    "solve": (torch.linalg.solve, (3, 3), (3, 2)),
    "inverse": (torch.inverse, (3, 3)),
    "singular values": (lambda x: torch.linalg.svd(x, full_matrices=False)[1], (4, 3)),
    "cross": (torch.linalg.cross, (4, 3), (4, 3)),
    "einsum": (lambda x, y: torch.einsum("ij,kj->ik", x, y), (3, 4), (2, 4)),
    "attention": (lambda q, k, v: (q @ k.mT / 2).softmax(-1) @ v, (2, 4, 8), (2, 4, 8), (2, 4, 8)),
    "layer_norm": (lambda x: F.layer_norm(x, (8,)), (2, 8)),
    "convolution": (lambda x, w: F.conv2d(x, w, padding=1, stride=2), (2, 3, 8, 8), (4, 3, 3, 3)),
    "transposed convolution": (lambda x, w: F.conv_transpose2d(x, w, stride=2), (2, 3, 4, 4), (3, 2, 4, 4)),
    "grid_sample": (lambda x, g: F.grid_sample(x, g.tanh(), align_corners=False), (1, 2, 5, 5), (1, 3, 3, 2)),
    "interpolate": (lambda x: F.interpolate(x, (8, 8), mode="bilinear", antialias=True), (1, 2, 5, 5)),
    "pixel_shuffle": (lambda x: F.pixel_shuffle(x, 2), (1, 4, 3, 3)),
    "avg_pool2d": (lambda x: F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False), (1, 2, 5, 5)),
    "adaptive_avg_pool2d": (lambda x: F.adaptive_avg_pool2d(x, 2), (1, 2, 5, 5)),
    "leaky_relu_": (lambda x: F.leaky_relu_(x * 1, 0.2), (8,)),
    "checkpoint": (lambda x: checkpoint(lambda y: (y.sin() * 2).exp(), x, use_reentrant=False), (4,)),
    "host scalars": (lambda x: x.sum() * torch.tensor(2.0) + torch.zeros(()), (3,)),
    "orthogonal steps": (lambda x: torch.baddbmm(x, x @ x.mT, x, beta=3.4, alpha=-4.8), (2, 3, 4)),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_have_the_hosts_values_and_gradients(device, name):
    function, *shapes = OPERATIONS[name]
    check_same(function, device, *shapes)


FACTORIES = {
    "arange": lambda d: torch.arange(5, device=d),
    "linspace": lambda d: torch.linspace(0, 1, 4, device=d),
    "eye": lambda d: torch.eye(3, device=d),
    "full": lambda d: torch.full((2,), 3.0, device=d),
    "tensor": lambda d: torch.tensor([[1, 2]], device=d),
    "as_tensor": lambda d: torch.as_tensor(np.ones(3), device=d),
    "randn": lambda d: torch.randn(2, 3, device=d),
    "new_full": lambda d: torch.zeros(2, device=d).new_full((2, 2), 1.0),
    "new_tensor": lambda d: torch.zeros(2, device=d).new_tensor([1.0, 2.0]),
}


@pytest.mark.parametrize("name", FACTORIES)
def test_what_is_asked_for_on_the_device_is_made_there(device, name):
    made = FACTORIES[name](device)
    assert isinstance(made, PretendedTensor)
    assert made.device.type == device.type
    assert made.shape == made.host.shape


MIXTURES = {
    "sum": lambda x, y: x + y,
    "product": lambda x, y: y @ x,
    "cat": lambda x, y: torch.cat([x, y]),
    "stack of numbers": lambda x, y: torch.stack([x[0, 0], y[0, 0]]),
    "in place on the host": lambda x, y: y.add_(x),
    "total on the host": lambda x, y: torch.zeros(()).add_(x[0, 0]),
    "index on the device": lambda x, y: y[index(x, 0)],
    "rows to add on the host": lambda x, y: x.index_add_(0, torch.tensor([0]), x[:1]),
    "mask on the host": lambda x, y: torch.where(y > 0, x, x),
    "layer on the device": lambda x, y: nn.Linear(3, 3).to(x.device)(y),
    "generator of the host": lambda x, y: torch.randn(3, device=x.device, generator=torch.Generator()),
}


@pytest.mark.parametrize("name", MIXTURES)
def test_tensors_in_two_places_do_not_mix(device, name):
    with pytest.raises(MixedDevicesError):
        MIXTURES[name](torch.randn(3, 3, device=device), torch.randn(3, 3))


@pytest.mark.parametrize("read", [PretendedTensor.numpy, np.asarray, np.array])
def test_nothing_on_the_device_is_a_numpy_array(device, read):
    with pytest.raises(TypeError, match="NumPy"):
        read(torch.ones(3, device=device))


WAITS = {
    "item": lambda x: x[0].item(),
    "bool": lambda x: bool(x[0] > 0),
    "float": lambda x: float(x[0]),
    "tolist": lambda x: x.tolist(),
    "nonzero": lambda x: x.nonzero(),
    "mask": lambda x: x[x > 0],
    "unique": lambda x: x.unique(),
    "equal": lambda x: torch.equal(x, x),
    "cpu": lambda x: x.cpu(),
    "from pageable memory": lambda x: torch.ones(3).to(x.device, non_blocking=True),
    "tensor of a list": lambda x: torch.tensor([1.0], device=x.device),
    "new_tensor": lambda x: x.new_tensor([1.0]),
    "list as index": lambda x: x[[0, 1]],
    "index on the host": lambda x: x[torch.tensor([0])],
    "solve": lambda x: torch.linalg.inv(torch.eye(2, device=x.device)),
    "repeat by values": lambda x: x.repeat_interleave((x > 0).long()),
}


@pytest.mark.parametrize("name", WAITS)
def test_a_wait_of_the_host_is_counted_by_its_place_or_refused(device, name):
    x = torch.randn(3, device=device)
    with watch() as log:
        WAITS[name](x)
    assert log.waits
    assert all(__file__ in wait.place for wait in log.waits)
    with watch(allowed=False), pytest.raises(HostWaitError, match=r"test_pretended_device\.py:\d+"):
        WAITS[name](x)


def test_the_host_goes_on_where_nothing_is_read(device):
    x = torch.randn(3, device=device)
    with watch(allowed=False) as log:
        torch.ones(3).pin_memory().to(device, non_blocking=True)
        (x * 2).softmax(0).cumsum(0).sort().values[1:].topk(1)
        x.new_zeros(3), torch.arange(3, device=device), x.masked_fill(x > 0, 0.0)
    assert log.operations["softmax"] + log.operations["_softmax"] == 1


def test_views_are_no_operations(device):
    x = torch.randn(3, 4, device=device)
    with watch() as log:
        x[1:].T.unsqueeze(0).reshape(1, 8)[..., :2].detach()
    # Only the transposed matrix has to be copied, to be another shape.
    assert sum(log.operations.values()) == 1


@pytest.mark.parametrize("how", [{"fused": True}, {"foreach": True}, {"foreach": False}])
def test_training_a_layer_gives_the_hosts_weights(device, how):
    weights = []
    for place in ("cpu", device):
        torch.manual_seed(0)
        net = nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.ConvTranspose2d(4, 2, 4, 2))
        first = net[0].weight
        optimizer = torch.optim.Adam(net.parameters(), 1e-2, **how)
        net.to(place)
        assert net[0].weight is first
        image = torch.arange(192.0).reshape(1, 3, 8, 8).to(place) / 100
        for _ in range(3):
            optimizer.zero_grad()
            net(image).square().mean().backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
        weights.append(torch.cat([p.detach().cpu().flatten() for p in net.parameters()]))
    assert torch.equal(*weights)


def test_modules_are_copied_loaded_and_changed_as_on_the_host(device):
    net = nn.BatchNorm2d(3).to(device)
    twin = copy.deepcopy(net)
    twin.weight.data = F.pad(twin.weight.data * 3, (0, 2))
    assert isinstance(twin.weight, nn.Parameter)
    assert twin.weight.tolist() == [3, 3, 3, 0, 0]
    assert net.weight.tolist() == [1, 1, 1]
    net.load_state_dict({name: value.cpu() + 1 for name, value in net.state_dict().items()})
    assert net.weight.device.type == device.type
    assert net.weight.tolist() == [2, 2, 2]
    net.to(torch.bfloat16)
    assert net.weight.host.dtype == torch.bfloat16


def test_layouts_and_shapes_follow_the_values(device):
    x = torch.randn(2, 4, 5, 5, device=device).contiguous(memory_format=torch.channels_last)
    assert x.is_contiguous(memory_format=torch.channels_last)
    y = torch.randn(2, 1, 3, device=device)
    y.squeeze_(1).unsqueeze_(0).transpose_(1, 2)
    assert y.shape == y.host.shape == (1, 3, 2)
    assert y.stride() == y.host.stride()
    out = torch.empty(0, device=device)
    torch.add(y, y, out=out)
    assert out.shape == out.host.shape == (1, 3, 2)


def test_inference_mode_and_autocast_are_those_of_torch(device):
    layer = nn.Conv2d(2, 3, 3).to(device)
    image = torch.randn(1, 2, 5, 5)
    with torch.inference_mode():
        assert (torch.zeros(3, device=device) * 2).is_inference()
        assert layer(image.to(device)).cpu().device.type == "cpu"
    with torch.autocast(device.type, dtype=torch.bfloat16):
        there = layer(image.to(device))
        assert there.softmax(-1).dtype == torch.float32
    with torch.autocast("cpu", dtype=torch.bfloat16):
        here = copy.deepcopy(layer).to("cpu")(image)
    assert there.dtype == torch.bfloat16
    assert torch.equal(here.float(), there.float().cpu())


def test_a_recorded_graph_computes_when_it_is_replayed_and_not_before(device):
    x, total = torch.zeros(3, device=device), torch.zeros(3, device=device)
    graph = RecordedGraph()
    with graph.capture():
        y = (x + 1) * 2
        total.add_(y)
        end = total.clone()[1:]
    assert total.tolist() == [0, 0, 0]
    assert y.isnan().all()
    for k in range(3):
        x.fill_(k)
        graph.replay()
        assert y.tolist() == [2 * (k + 1)] * 3
    assert end.tolist() == [12, 12]


def test_a_wait_while_a_graph_is_recorded_is_an_error(device):
    x = torch.ones(3, device=device)
    with pytest.raises(HostWaitError), RecordedGraph().capture():
        x.sum().item()
