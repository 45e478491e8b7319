"""Filters are expanded once where they may be, and never served stale."""

import contextvars
import copy
import threading

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call, stack_module_state, vmap

from equirl.modules import FieldType, SteerableConv, make_critic, shared_filters
from equirl.symmetry import SymmetryGroup

GROUP = SymmetryGroup("D4")


@pytest.fixture
def layer():
    return SteerableConv(FieldType.regular(GROUP, 2), FieldType.regular(GROUP, 3), padding=1)


@pytest.fixture
def expansions(monkeypatch):
    """Counts the expansions."""
    calls, expand = [], SteerableConv._expand
    monkeypatch.setattr(
        SteerableConv, "_expand", lambda self, weights: calls.append(1) or expand(self, weights)
    )
    return calls


X = torch.randn(2, 16, 4, 4)


def test_expanded_once_inside_and_every_time_outside(layer, expansions):
    plain = layer(X)
    layer(X)
    assert len(expansions) == 2
    with shared_filters():
        assert torch.equal(layer(X), plain)
        assert torch.equal(layer(X), plain)
        with shared_filters():  # shares the outer one's
            layer(X)
    assert len(expansions) == 3
    with shared_filters():  # a new context begins empty
        layer(X)
    assert len(expansions) == 4


def test_gradients_are_those_without_sharing(layer):
    layer, x = layer.double(), X.double()
    (layer(x).square().sum() + layer(2 * x).sum()).backward()
    expected = [p.grad.clone() for p in layer.parameters()]
    layer.zero_grad()
    with shared_filters():
        (layer(x).square().sum() + layer(2 * x).sum()).backward()
    for parameter, gradient in zip(layer.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_detached_weights_reuse_the_filter_without_its_graph(layer, expansions):
    detached = {name: p.detach() for name, p in layer.named_parameters()}
    with shared_filters():
        attached = layer(X)
        x = X.clone().requires_grad_()
        out = functional_call(layer, detached, (x,))
        assert len(expansions) == 1
        (gradient,) = torch.autograd.grad(out.sum(), x)
        assert torch.equal(out, attached)
        with torch.no_grad():
            assert not layer(X).requires_grad
        assert len(expansions) == 1
        attached.sum().backward()
    assert layer.weights.grad is not None
    assert gradient.abs().sum() > 0


def test_a_filter_of_a_pass_without_gradients_serves_one_with(layer, expansions):
    with shared_filters():
        with torch.no_grad():
            assert not layer(X).requires_grad
        layer(X).sum().backward()
        assert len(expansions) == 1
    assert layer.weights.grad is not None


def test_gradient_reaches_the_tensor_passed_not_its_twin(layer):
    twin = layer.weights.detach().requires_grad_()  # same memory, another leaf
    with shared_filters():
        layer(X)
        functional_call(layer, {"weights": twin}, (X,)).sum().backward()
    assert twin.grad is not None
    assert layer.weights.grad is None


@pytest.mark.parametrize("through", ["weights", "data", "detach"])
def test_updated_weights_are_seen(layer, through):
    views = {"weights": layer.weights, "data": layer.weights.data, "detach": layer.weights.detach()}
    with shared_filters(), torch.no_grad():
        before = layer(X)
        views[through].add_(1.0)  # `.data` does not count versions
        after = layer(X)
    assert not torch.equal(before, after)
    torch.testing.assert_close(after, layer(X))


def test_swapped_parameters_have_filters_of_their_own():
    critic = make_critic("D4", hidden=8, image_size=16)
    own, target = TensorDict.from_module(critic), TensorDict.from_module(copy.deepcopy(critic))
    target = target.data.apply(lambda p: p + 0.1 * torch.randn_like(p))
    data = TensorDict(
        depth=torch.rand(2, 1, 16, 16),
        holding=torch.ones(2, 1),
        action=torch.rand(2, 5),
        batch_size=2,
    )

    def values(params):
        with params.to_module(critic):
            return critic(data.clone())["state_action_value"]

    expected = [values(own), values(target), values(own.data)]
    with shared_filters():
        shared = [values(own), values(target), values(own.data), values(target)]
        for ours, theirs in zip(shared, [*expected, expected[1]], strict=True):
            assert torch.equal(ours, theirs)
        shared[0].sum().backward()
    assert all(p.grad is not None for p in critic.parameters())


def test_a_functional_swap_holds_parameters_only():
    critic = make_critic("D4", hidden=8, image_size=16)
    swapped = TensorDict.from_module(critic)
    assert len(list(swapped.keys(True, True))) == len(critic.state_dict())


def test_dtypes_are_kept_apart(layer):
    with shared_filters():
        layer(X)
        assert layer.double()(X.double()).dtype == torch.float64


def test_inference_mode_does_not_leak_into_training(layer):
    with shared_filters():
        with torch.inference_mode():
            layer(X)
        x = X.clone().requires_grad_()
        functional_call(layer, {"weights": layer.weights.detach()}, (x,)).sum().backward()
    assert x.grad is not None


def test_vmap_and_export_work_inside(layer):
    twin = copy.deepcopy(layer)
    parameters, _ = stack_module_state([layer, twin])
    with shared_filters():
        layer(X)
        out = vmap(lambda p: functional_call(layer, p, (X,)))(parameters)
        exported = torch.export.export(layer, (X,)).module()
    torch.testing.assert_close(out[0], layer(X))
    torch.testing.assert_close(exported(X), layer(X))


def test_threads_do_not_share(layer, expansions):
    with shared_filters():
        layer(X)
        worker = threading.Thread(target=contextvars.Context().run, args=(layer, X))
        worker.start()
        worker.join()
    assert len(expansions) == 2


def test_dropped_after_an_error(layer, expansions):
    with pytest.raises(RuntimeError, match="stop"), shared_filters():
        layer(X)
        raise RuntimeError("stop")
    layer(X)
    assert len(expansions) == 2
