"""Activations, pooling and gated networks are torch modules like any other."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.func import functional_call, stack_module_state, vmap

from equirl.modules import (
    EquivariantQHeads,
    FieldMaxPool,
    FieldReLU,
    FieldType,
    GatedNonlinearity,
    GroupMaxPool,
    NormMaxPool,
    NormPool,
    make_actor,
    make_critic,
)
from equirl.symmetry import SymmetryGroup

HIDDEN = FieldType.hidden(SymmetryGroup("O2"), 2)
REGULAR = FieldType.regular(SymmetryGroup("D4"), 2)
MODULES = {
    "relu": lambda: FieldReLU(REGULAR),
    "gates": lambda: GatedNonlinearity(HIDDEN),
    "pointwise maximum": lambda: FieldMaxPool(REGULAR),
    "shared maximum": lambda: NormMaxPool(HIDDEN),
    "first maximum": lambda: NormMaxPool(HIDDEN, ties="first"),
    "maximum over the group": lambda: GroupMaxPool(REGULAR),
    "norms": lambda: NormPool(HIDDEN),
}


@pytest.fixture(params=MODULES)
def module(request):
    module = MODULES[request.param]()
    for parameter in module.parameters():
        nn.init.normal_(parameter)
    return module


def inputs(module, batch=3, dtype=torch.float32):
    """Maps for pooling over pixels, vectors of fields for the others."""
    generator = torch.Generator().manual_seed(0)
    pixels = (4, 6) if isinstance(module, NormMaxPool | FieldMaxPool) else ()
    shape = (batch, module.in_type.size, *pixels)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)


def apply(module, x):
    return module(x.clone())  # a ReLU works in the memory of its input


def networks(group="O2", mode="strict"):
    """Policy, encoder and heads of a small actor and critic, with observation and action."""
    kwargs = {"hidden": 8, "image_size": 16, "mode": mode, "backend": "dense"}
    generator = torch.Generator().manual_seed(0)
    actor, critic = (
        make(group, generator=generator, **kwargs) for make in (make_actor, make_critic)
    )
    observation = torch.rand(3, 1, 16, 16, generator=generator), torch.ones(3, 1)
    parts = actor.module[0].module, critic[0].module, critic[1].module
    return *parts, observation, torch.rand(3, 5, generator=generator)


def test_precision_follows_the_module(module):
    x = inputs(module)
    before = apply(module, x)
    precise = apply(module.double(), x.double())
    assert (before.dtype, precise.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(before.double(), precise, atol=1e-6, rtol=1e-5)
    assert torch.equal(apply(module.float(), x), before)
    assert apply(module.bfloat16(), x.bfloat16()).dtype == torch.bfloat16


def test_the_state_is_the_parameters_and_constants_are_not_swapped(module):
    names = {name for name, _ in module.named_parameters()}
    assert set(module.train().state_dict()) == names == set(module.eval().state_dict())
    assert not list(module.buffers())
    assert set(TensorDict.from_module(module).keys(True, True)) == names
    assert names == ({"bias"} if isinstance(module, GatedNonlinearity) else set())


def test_devices(module):
    """Made without memory, then given some and the state of another, as large models are loaded."""
    state, x = module.state_dict(), inputs(module)
    expected = apply(module, x)
    empty = copy.deepcopy(module).to("meta")
    assert apply(empty, x.to("meta")).shape == expected.shape
    loaded = empty.to_empty(device="cpu")
    loaded.load_state_dict(state)
    assert torch.equal(apply(loaded, x), expected)


def test_constants_are_made_on_the_cpu_whatever_the_default_device():
    with torch.device("meta"):
        modules = [GatedNonlinearity(HIDDEN), NormMaxPool(HIDDEN), NormPool(HIDDEN)]
    for module in modules:
        assert apply(module, inputs(module)).device.type == "cpu"


def test_pickle_and_deepcopy(module):
    x = inputs(module)
    expected = apply(module, x)
    for other in (pickle.loads(pickle.dumps(module)), copy.deepcopy(module)):
        assert torch.equal(apply(other, x), expected)
        assert torch.equal(apply(other.double().float(), x), expected)


def test_vmap(module):
    x = torch.stack([inputs(module), 2 * inputs(module)])
    expected = torch.stack([apply(module, part) for part in x])
    torch.testing.assert_close(vmap(lambda part: apply(module, part))(x), expected)


def test_vmap_over_stacked_biases_of_gates():
    modules = [GatedNonlinearity(HIDDEN) for _ in range(3)]
    for module in modules:
        nn.init.normal_(module.bias)
    parameters, buffers = stack_module_state(modules)
    assert not buffers
    x = inputs(modules[0])
    out = vmap(lambda p: functional_call(modules[0], p, (x,)))(parameters)
    torch.testing.assert_close(out, torch.stack([module(x) for module in modules]))


def test_export_and_compile(module):
    x = inputs(module)
    expected = apply(module, x)
    exported = torch.export.export(module, (x.clone(),)).module()
    torch.testing.assert_close(exported(x.clone()), expected)
    compiled = torch.compile(module, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x.clone()), expected)


def test_no_gradient_is_lost_at_zero(module):
    x = torch.zeros_like(inputs(module)).requires_grad_()
    (gradient,) = torch.autograd.grad(apply(module, x).sum(), x)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize(
    ("group", "mode"),
    [
        ("O2", "strict"),
        pytest.param("SO2", "paper", marks=pytest.mark.slow),
        pytest.param("D4", "strict", marks=pytest.mark.slow),
    ],
)
def test_networks_compile_without_a_break_before_they_were_ever_called(group, mode):
    policy, encoder, heads, observation, action = networks(group, mode)
    compiled = torch.compile(policy, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(*observation), policy(*observation))
    features = encoder(*observation).detach()
    compiled = torch.compile(heads, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(features, action), heads(features, action))


@pytest.mark.parametrize("group", ["SO2", "O2"])
def test_gated_networks_over_stacked_parameters(group):
    """As ensembles of critics are evaluated."""
    made = [networks(group)[1:3] for _ in range(2)]
    for parameter in made[1][0].parameters():
        nn.init.normal_(parameter, std=0.1)
    (*_, observation, action), (encoder, heads) = networks(group), made[0]
    features = vmap(lambda p: functional_call(encoder, p, observation))(
        stack_module_state([pair[0] for pair in made])[0]
    )
    expected = torch.stack([pair[0](*observation) for pair in made])
    torch.testing.assert_close(features, expected, atol=1e-5, rtol=1e-4)
    values = vmap(lambda p, x: functional_call(heads, p, (x, action)))(
        stack_module_state([pair[1] for pair in made])[0], expected
    )
    expected = torch.stack([p[1](x, action) for p, x in zip(made, expected, strict=True)])
    torch.testing.assert_close(values, expected, atol=1e-5, rtol=1e-4)


def test_networks_made_without_memory_load_the_state_of_others():
    policy, *_, observation, _ = networks()
    empty = make_actor("O2", hidden=8, image_size=16, backend="dense", device="meta")
    assert all(parameter.is_meta for parameter in empty.parameters())
    other = empty.module[0].module.to_empty(device="cpu")
    other.load_state_dict(policy.state_dict())
    for mine, its in zip(other(*observation), policy(*observation), strict=True):
        assert torch.equal(mine, its)


def test_heads_take_the_features_of_an_encoder_only():
    for fields in (HIDDEN + FieldType.trivial(HIDDEN.group, 1), FieldType.trivial(HIDDEN.group, 5)):
        with pytest.raises(ValueError, match=r"expected the hidden fields of an encoder, got O2\["):
            EquivariantQHeads(fields)
