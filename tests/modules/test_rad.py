"""The centre crop and RAD's networks; what every method builds."""

import pytest
import torch
from tensordict import TensorDict

from equirl.modules import (
    METHODS,
    CenterCropped,
    CNNEncoder,
    make_cnn_actor,
    make_cnn_critic,
    make_rad_actor,
    make_rad_critic,
    uncropped,
)

SMALL = {"hidden": 8, "image_size": 16}
CROPPING = [name for name, method in METHODS.items() if method.crops]


def observations(count, size):
    return TensorDict(
        depth=0.3 * torch.rand(count, 1, size, size),
        holding=torch.randint(2, (count, 1)).float(),
        batch_size=[count],
    )


def small(make, **kwargs):
    return make(**SMALL, generator=torch.Generator().manual_seed(1), **kwargs)


def test_uncropped_sizes_are_in_the_papers_proportion_and_even():
    sizes = {size: uncropped(size) for size in (16, 32, 64, 128, 256)}
    assert sizes == {16: 18, 32: 36, 64: 72, 128: 142, 256: 284}


@pytest.mark.parametrize("name", CROPPING)
@pytest.mark.parametrize(("size", "margin"), [(16, 1), (128, 7)])
def test_acting_sees_the_centre_of_the_image(name, size, margin):
    method, kwargs = METHODS[name], {"hidden": 8, "image_size": size}
    actor, critic = method.make_actor(**kwargs), method.make_critic(**kwargs)
    full = observations(3, size + 2 * margin)
    centre = full.clone()
    centre["depth"] = full["depth"][:, :, margin : margin + size, margin : margin + size]
    with torch.no_grad():
        seen, expected = critic(actor(full)), critic(actor(centre))
    for key in ("loc", "scale", "action", "state_action_value"):
        assert torch.equal(seen[key], expected[key]), key


@pytest.mark.parametrize("name", CROPPING)
@pytest.mark.parametrize("shape", [(17, 17), (20, 20), (16, 18), (8, 8)])
def test_images_of_another_size_are_refused(name, shape):
    depth, holding = torch.rand(2, 1, *shape), torch.ones(2, 1)
    message = rf"18 x 18 pixels.* cropped to 16 x 16, got the shape \(2, 1, {shape[0]}, {shape[1]}"
    networks = small(METHODS[name].make_actor), small(METHODS[name].make_critic)
    for network in networks:
        with pytest.raises(ValueError, match=message):
            network.module[0].module(depth, holding)


@pytest.mark.parametrize("name", CROPPING)
@pytest.mark.parametrize("size", [16, 18])
def test_networks_export_at_either_size(name, size):
    policy, data = small(METHODS[name].make_actor).module[0].module, observations(3, size)
    inputs = (data["depth"], data["holding"])
    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(policy, inputs, dynamic_shapes=({0: batch}, {0: batch}))
    torch.testing.assert_close(program.module()(*inputs), policy(*inputs))
    more = observations(5, size)
    assert program.module()(more["depth"], more["holding"])[0].shape == (5, 5)


@pytest.mark.parametrize("name", CROPPING)
def test_networks_vmap_over_their_parameters(name):
    first, second = (METHODS[name].make_actor(**SMALL).module[0].module for _ in range(2))
    params = {
        key: torch.stack([value, dict(second.named_parameters())[key]]).detach()
        for key, value in first.named_parameters()
    }
    data = observations(3, 18)
    inputs = data["depth"], data["holding"]

    def run(params):
        return torch.func.functional_call(first, params, inputs)

    both = torch.func.vmap(run)(params)
    for index, policy in enumerate((first, second)):
        for ours, expected in zip(both, policy(*inputs), strict=True):
            torch.testing.assert_close(ours[index], expected, atol=1e-5, rtol=1e-4)


def test_rad_is_the_cnn_behind_a_crop():
    data = observations(4, 16)
    rad = small(make_rad_critic)(small(make_rad_actor)(data.clone()))
    cnn = small(make_cnn_critic)(small(make_cnn_actor)(data.clone()))
    for key in ("loc", "scale", "state_action_value"):
        assert torch.equal(rad[key], cnn[key]), key


def test_a_crop_serves_encoders_of_other_arguments():
    class Mean(torch.nn.Module):
        def forward(self, image, invariants=None):
            return image.mean((-3, -2, -1))

    image = torch.zeros(2, 3, 18, 18)
    image[:, :, 1:-1, 1:-1] = 1
    assert torch.equal(CenterCropped(Mean(), 16)(image), torch.ones(2))
    assert "18 -> 16" in repr(CenterCropped(CNNEncoder(**SMALL), 16))


def test_methods_ask_of_training_what_they_are_made_of():
    asked = {name: (m.shifts, m.crops, m.contrastive) for name, m in METHODS.items()}
    assert asked == {
        "equivariant": (False, False, False),
        "cnn": (False, False, False),
        "drq": (True, False, False),
        "rad": (False, True, False),
        "ferm": (False, True, True),
    }
    assert [name for name, method in METHODS.items() if method.equivariant] == ["equivariant"]


@pytest.mark.parametrize("name", METHODS)
def test_critics_of_every_method_have_any_number_of_heads(name):
    method = METHODS[name]
    group = {"group": "C4"} if method.equivariant else {}
    actor, critic = (
        method.make_actor(**group, **SMALL),
        method.make_critic(**group, **SMALL, heads=3),
    )
    data = observations(2, uncropped(16) if method.crops else 16)
    assert critic(actor(data))["state_action_value"].shape == (2, 3)
    with pytest.raises(ValueError, match="heads=0: expected a positive integer"):
        method.make_critic(**group, **SMALL, heads=0)
