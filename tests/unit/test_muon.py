"""Muon: orthogonal steps, on a problem that Adam finds hard."""

import torch

from dsar.training.muon import Muon, orthogonalize


def polynomial_steps(matrix):
    """Apply Jordan's polynomial to the singular values five times, matrix by matrix, in float64."""
    x = matrix.double()
    x = (x.mT if len(x) > x.shape[1] else x) / x.norm()
    for _ in range(5):
        gram = x @ x.mT
        x = 3.4445 * x + (-4.7750 * gram + 2.0315 * gram @ gram) @ x
    return x.mT if len(matrix) > matrix.shape[1] else x


def test_orthogonalised_matrix_keeps_its_singular_vectors_and_evens_out_its_singular_values():
    generator = torch.Generator().manual_seed(0)
    for shape in ((16, 40), (40, 16), (8, 8)):
        u, _, vh = torch.linalg.svd(torch.randn(*shape, generator=generator), full_matrices=False)
        strengths = torch.logspace(0, -1.5, u.shape[1])
        result = orthogonalize([u * strengths @ vh])[0]
        inside = u.mT @ result @ vh.mT
        assert (inside - inside.diagonal().diag()).abs().max() < 1e-4
        assert (inside.diagonal() > 0.6).all()
        assert (inside.diagonal() < 1.3).all()
    assert torch.equal(orthogonalize([torch.zeros(3, 4)])[0], torch.zeros(3, 4))


def test_matrices_of_all_shapes_and_scales_together_are_what_each_is_alone():
    generator = torch.Generator().manual_seed(4)
    shapes = ((6, 10), (6, 10), (10, 6), (6, 6), (6, 40), (3, 5), (1, 7), (64, 64), (64, 576))
    scales = torch.logspace(-12, 3, len(shapes))
    matrices = [scale * torch.randn(*s, generator=generator) for s, scale in zip(shapes, scales, strict=True)]
    for result, matrix in zip(orthogonalize(matrices), matrices, strict=True):
        torch.testing.assert_close(result, polynomial_steps(matrix).float(), rtol=1e-3, atol=1e-4)


def test_a_weight_keeps_its_norm_however_many_steps_push_it_one_way():
    weight = torch.nn.Parameter(torch.randn(8, 3, 3, 3, generator=torch.Generator().manual_seed(2)))
    push, norm = torch.ones_like(weight), weight.detach().norm()
    optimizer = Muon([weight])
    optimizer.param_groups[0]["lr"] = 0.2
    for _ in range(500):
        weight.grad = push.clone()
        optimizer.step()
    torch.testing.assert_close(weight.detach().norm(), norm)
    assert torch.nn.functional.cosine_similarity(weight.detach().flatten(), -push.flatten(), 0) > 0.99


def test_muon_fits_an_ill_conditioned_regression_that_gradient_descent_does_not():
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(200, 12, generator=generator) * torch.logspace(0, -2, 12)
    truth = torch.randn(12, 6, generator=generator)
    start = torch.randn(6, 12, generator=generator)
    start *= truth.norm() / start.norm()

    def fit(make):
        weight = torch.nn.Parameter(start.clone())
        optimizer = make([weight])
        for step in range(300):
            for group in optimizer.param_groups:
                group["lr"] = group.get("peak", 1.0) * 0.5 * (1 - step / 300)
            optimizer.zero_grad()
            (inputs @ (weight.T - truth)).square().mean().backward()
            optimizer.step()
        return float((weight.T - truth).detach().square().mean())

    assert fit(Muon) < 0.1
    assert fit(Muon) < 0.5 * fit(lambda weights: torch.optim.SGD(weights, lr=1.0))
