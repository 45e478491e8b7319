"""The radial squash against numerical integration, autograd, and TorchRL's own."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd.functional import jacobian
from torchrl.modules import TanhNormal
from torchrl.objectives.sac import compute_rsample_log_prob

from equirl.modules import RadialTanhNormal
from equirl.symmetry import ACTION, Element, Representation

VECTOR = Representation("vector")
DOUBLE = torch.float64


def action_distribution(rows=3, seed=0, dtype=DOUBLE, spread=0.5):
    generator = torch.Generator().manual_seed(seed)
    loc = torch.randn(rows, 5, generator=generator, dtype=DOUBLE)
    scale = spread * (0.5 + torch.rand(rows, 5, generator=generator, dtype=DOUBLE))
    scale[:, 2] = scale[:, 1]
    return RadialTanhNormal(loc.to(dtype), scale.to(dtype), ACTION)


@pytest.mark.parametrize("loc", [(0.0, 0.0), (0.3, -0.4), (0.0, 1.2)])
@pytest.mark.parametrize("scale", [(0.5, 0.5), (1.0, 1.0), (0.4, 0.7)])
def test_density_integrates_to_one_over_the_disc(loc, scale):
    dist = RadialTanhNormal(
        torch.tensor(loc, dtype=DOUBLE), torch.tensor(scale, dtype=DOUBLE), VECTOR
    )
    # Midpoint rule in polar coordinates; radii placed by atanh, where the mass is.
    raw = (torch.arange(600, dtype=DOUBLE) + 0.5) * (7.0 / 600)
    angle = (torch.arange(200, dtype=DOUBLE) + 0.5) * (math.tau / 200)
    radius, area = torch.tanh(raw), torch.tanh(raw) * (1 - torch.tanh(raw) ** 2) * 7.0 / 600
    points = radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], -1)
    total = (dist.log_prob(points).exp() * area[:, None]).sum() * math.tau / 200
    assert total.item() == pytest.approx(1, abs=1e-4)


def test_density_integrates_to_one_over_the_interval():
    dist = RadialTanhNormal(torch.full((1,), 0.3), torch.full((1,), 0.6), Representation("sign"))
    x = (torch.arange(20000, dtype=DOUBLE) + 0.5) / 10000 - 1
    assert dist.log_prob(x[:, None]).exp().mean().item() * 2 == pytest.approx(1, abs=1e-4)


def squash(raw):
    """What becomes of a vector: the greedy action of a Gaussian there."""
    return RadialTanhNormal(raw, torch.ones_like(raw), VECTOR).deterministic_sample


def log_determinant(raw):
    """Of the squash at a vector: what the Gaussian's density there is divided by."""
    dist = RadialTanhNormal(raw, torch.ones_like(raw), VECTOR)
    return -math.log(math.tau) - dist.log_prob(dist.deterministic_sample)


@pytest.mark.parametrize("length", [1e-6, 1e-3, 0.0099, 0.0101, 0.3, 1.0, 4.0])
def test_log_determinant_is_that_of_the_jacobian(length):
    raw = length * torch.tensor([math.cos(0.7), math.sin(0.7)], dtype=DOUBLE)
    expected = jacobian(squash, raw).det().log()
    torch.testing.assert_close(log_determinant(raw), expected, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("squared", [0.99e-4, 1.01e-4])
def test_series_and_closed_form_meet(squared):
    r = math.sqrt(squared)
    raw = torch.tensor([r, 0.0], dtype=DOUBLE, requires_grad=True)
    log_det = log_determinant(raw)
    expected = -2 * math.log(math.cosh(r)) + math.log(math.tanh(r) / r)
    assert log_det.item() == pytest.approx(expected, abs=1e-14)
    (gradient,) = torch.autograd.grad(log_det, raw)
    slope = -3 * math.tanh(r) + 1 / math.tanh(r) - 1 / r
    assert gradient[0].item() == pytest.approx(slope, abs=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("length", [0.0, 1e-20, 1e-8, 1e-2, 5.0, 20.0, 80.0])
def test_values_and_gradients_are_finite_at_every_length(length, dtype):
    loc = torch.zeros(5, dtype=dtype)
    loc[[0, 1, 3]] = torch.tensor([length, length, -length], dtype=dtype)
    loc.requires_grad_()
    scale = torch.full((5,), 1e-9, dtype=dtype, requires_grad=True)
    torch.manual_seed(0)
    raw = (loc + scale * torch.randn(5, dtype=dtype)).detach()
    torch.manual_seed(0)
    dist = RadialTanhNormal(loc, scale, ACTION)
    sample, log_prob = dist.rsample_and_log_prob()
    assert torch.isfinite(sample).all()
    for output in (sample.sum(), log_prob, dist.deterministic_sample.sum()):
        gradients = torch.autograd.grad(output, [loc, scale], retain_graph=True, allow_unused=True)
        assert gradients[0] is not None
        assert all(each is None or torch.isfinite(each).all() for each in gradients)
    normal = torch.distributions.Normal(loc, scale).log_prob(raw).sum()
    expected = -sum(map(_surprise, raw)) - _radial(raw)
    torch.testing.assert_close(normal - log_prob, expected, rtol=1e-5, atol=1e-4)


def _surprise(x):
    # -log(1 - tanh^2), by exponentials that do not overflow
    return 2 * (x.abs() + torch.log1p(torch.exp(-2 * x.abs())) - math.log(2))


def _radial(raw):
    r = raw[1:3].norm()
    return -torch.log(torch.tanh(r) / r) if r > 1e-6 else torch.zeros_like(r)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_any_stored_action_has_a_finite_score(dtype):
    dist = action_distribution(rows=4, dtype=dtype)
    actions = torch.tensor(
        [[0.0] * 5, [1.0, 1.0, 0.0, -1.0, 1.0], [1.0] * 5, [-1.0, -1.0, -1.0, 0.5, -1.0]],
        dtype=dtype,
    )  # at the origin, on the boundary, and at the corners outside the disc
    actions.requires_grad_()
    log_prob = dist.log_prob(actions)
    assert torch.isfinite(log_prob).all()
    (gradient,) = torch.autograd.grad(log_prob.sum(), actions)
    assert torch.isfinite(gradient).all()


def test_without_vectors_it_is_the_tanh_normal():
    loc, scale = torch.randn(4, 3, dtype=DOUBLE), torch.rand(4, 3, dtype=DOUBLE) + 0.1
    ours = RadialTanhNormal(loc, scale, Representation("trivial", "sign", "trivial"))
    theirs, values = TanhNormal(loc, scale), 0.9 * (2 * torch.rand(4, 3, dtype=DOUBLE) - 1)
    torch.testing.assert_close(ours.log_prob(values), theirs.log_prob(values), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(ours.deterministic_sample, theirs.deterministic_sample)


def test_score_of_a_fresh_sample_is_its_log_prob():
    dist = action_distribution(rows=64, spread=0.3)
    sample, log_prob = dist.rsample_and_log_prob((5,))
    assert sample.shape == (5, 64, 5)
    torch.testing.assert_close(log_prob, dist.log_prob(sample), atol=1e-6, rtol=1e-6)
    detached, log_prob = dist.sample_and_log_prob()
    torch.testing.assert_close(log_prob, dist.log_prob(detached), atol=1e-6, rtol=1e-6)


def test_torchrl_scores_saturated_samples_before_the_squash():
    loc = torch.full((1000, 5), 12.0, requires_grad=True)
    dist = RadialTanhNormal(loc, torch.full((1000, 5), 0.1), ACTION)
    torch.manual_seed(0)
    _, log_prob = compute_rsample_log_prob(dist)
    # E log N is known; log-slope about 2 (log 2 - r) each; r of the vector is 12 sqrt 2.
    normal = 5 * (-0.5 - 0.5 * math.log(math.tau) - math.log(0.1))
    r = 12 * math.sqrt(2)
    expected = normal - 2 * (3 * (math.log(2) - 12) + math.log(2) - r) + math.log(r)
    assert log_prob.mean().item() == pytest.approx(expected, abs=0.3)
    (gradient,) = torch.autograd.grad(log_prob.sum(), loc)
    assert gradient[:, 0].tolist() == pytest.approx([2.0] * 1000, abs=1e-3)


def test_samples_are_the_squashed_gaussian():
    dist = RadialTanhNormal(torch.tensor([0.5, 0.2]), torch.tensor([0.3, 0.3]), VECTOR)
    torch.manual_seed(0)
    raw = torch.tensor([0.5, 0.2]) + 0.3 * torch.randn(7, 2)
    torch.manual_seed(0)
    r = raw.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(dist.rsample((7,)), raw * torch.tanh(r) / r)


@given(st.floats(-7, 7), st.booleans(), st.integers(0, 1000), st.sampled_from([0.01, 0.3, 2.0]))
def test_every_rotation_and_reflection_commutes_with_the_distribution(angle, flip, seed, spread):
    g, dist = Element(angle, flip), action_distribution(seed=seed, spread=spread)
    turned = RadialTanhNormal(ACTION.transform(dist.loc, g), dist.scale, ACTION)
    action = action_distribution(seed=seed + 1).deterministic_sample
    torch.testing.assert_close(
        turned.log_prob(ACTION.transform(action, g)), dist.log_prob(action), atol=1e-9, rtol=1e-9
    )
    torch.testing.assert_close(turned.mode, ACTION.transform(dist.mode, g), atol=1e-12, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_samples_lie_in_the_support(dtype):
    dist = action_distribution(rows=1000, dtype=dtype, spread=20.0)
    sample = dist.sample((3,))
    assert dist.support.check(sample).all()
    assert (sample.abs() <= 1).all()
    assert not dist.support.check(torch.tensor([0.0, 0.8, 0.8, 0.0, 0.0]))


def test_shapes_follow_torch():
    dist = action_distribution(rows=3)
    assert (dist.batch_shape, dist.event_shape) == ((3,), (5,))
    assert dist.sample((2,)).shape == (2, 3, 5)
    assert dist.expand((4, 3)).sample().shape == (4, 3, 5)
    single = RadialTanhNormal(torch.zeros(5), torch.ones(5), ACTION)
    assert single.log_prob(torch.zeros(5)).shape == ()


def test_wrong_dimensions_are_refused_and_the_mean_is_not_invented():
    with pytest.raises(ValueError, match="last dimension of 5"):
        RadialTanhNormal(torch.zeros(4), torch.ones(4), ACTION)
    with pytest.raises(NotImplementedError, match="average samples"):
        _ = action_distribution().mean
