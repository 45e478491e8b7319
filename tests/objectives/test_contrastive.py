"""The contrastive loss against a plain, independent computation."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import SoftUpdate

from equirl.modules import make_ferm_actor, make_ferm_critic
from equirl.objectives import ContrastiveLoss, SACLoss
from equirl.symmetry import random_observations
from tests.transitions import transitions

SIZE, BATCH, TAU = 16, 6, 0.05


def crops(dtype=torch.float32, seed=0) -> TensorDict:
    """Two crops, a pixel apart, of each of some images."""
    generator = torch.Generator().manual_seed(seed)
    images = 0.3 * torch.rand(BATCH, 1, SIZE + 2, SIZE + 2, generator=generator, dtype=dtype)
    holding = torch.rand(BATCH, 1, generator=generator).round().to(dtype)
    return TensorDict(
        depth=images[..., :-2, 1:-1], positive=images[..., 1:-1, 2:], holding=holding,
        batch_size=[BATCH],
    )  # fmt: skip


def make_critic():
    return make_ferm_critic(hidden=8, image_size=SIZE, generator=torch.Generator().manual_seed(1))


def make_loss(critic) -> tuple[ContrastiveLoss, SoftUpdate]:
    loss = ContrastiveLoss(critic.module[0], generator=torch.Generator().manual_seed(2))
    return loss, SoftUpdate(loss, tau=TAU)


def test_loss_and_gradients_equal_a_plain_computation():
    critic = make_critic().double()
    loss, _ = make_loss(critic)
    query_encoder = copy.deepcopy(critic.module[0].module)
    key_encoder = copy.deepcopy(critic.module[0].module)
    # Keys that differ from the queries, or a mix-up of the two would go unseen.
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in key_encoder.parameters():
            parameter.mul_(1 + 0.3 * torch.rand(parameter.shape, generator=generator))
    state = {f"target_encoder_params.module.{n}": p for n, p in key_encoder.state_dict().items()}
    assert set(state) < set(loss.state_dict())
    loss.load_state_dict(loss.state_dict() | state)

    data = crops(torch.float64)
    result = loss(data.clone())
    result["loss_contrastive"].backward()

    similarity = loss.similarity.detach().clone().requires_grad_()
    queries = query_encoder(data["depth"], data["holding"])
    keys = key_encoder(data["positive"], data["holding"]).detach()
    terms, right = [], []
    for i in range(BATCH):
        row = torch.stack([(queries[i] * (similarity @ keys[j])).sum() for j in range(BATCH)])
        weights = (row - row.max()).exp()
        terms.append(-(weights[i] / weights.sum()).log())
        right.append(bool((row[i] >= row).all()))
    expected = sum(terms) / BATCH
    expected.backward()

    assert torch.isclose(result["loss_contrastive"], expected, rtol=0, atol=1e-6)
    assert result["contrastive_accuracy"] == sum(right) / BATCH
    assert not result["contrastive_accuracy"].requires_grad
    trained = critic.module[0].module.named_parameters()
    pairs = [(name, p, q) for (name, p), q in zip(trained, query_encoder.parameters(), strict=True)]
    for name, ours, plain in [*pairs, ("similarity", loss.similarity, similarity)]:
        assert plain.grad.any(), name
        torch.testing.assert_close(ours.grad, plain.grad, rtol=0, atol=1e-6, msg=name)
    assert all(p.grad is None for p in loss.target_encoder_params.values(True, True))


def test_accuracy_counts_the_keys_that_are_found():
    """With the query as its feature vector and W = 1, crops match where they are alike."""
    identity = torch.nn.Linear(4, 4, bias=False)
    torch.nn.init.eye_(identity.weight)
    encoder = TensorDictModule(identity, in_keys=["depth"], out_keys=["_features"])
    loss = ContrastiveLoss(encoder, features=4)
    SoftUpdate(loss, tau=TAU)
    with torch.no_grad():
        loss.similarity.copy_(torch.eye(4))
    order = torch.tensor([0, 1, 3, 2])
    data = TensorDict(depth=9 * torch.eye(4), positive=torch.eye(4)[order], batch_size=[4])
    result = loss(data)
    assert result["contrastive_accuracy"] == 0.5
    # Two rows have their 9 at the right place, two at a wrong one.
    total = torch.tensor([9.0, 0, 0, 0]).exp().sum().log()
    torch.testing.assert_close(result["loss_contrastive"], total - 9 / 2)


def test_the_keys_encoder_follows_slowly():
    critic = make_critic()
    loss, update = make_loss(critic)
    old = {name: p.clone() for name, p in critic.module[0].module.named_parameters()}
    with torch.no_grad():
        for parameter in critic.module[0].parameters():
            parameter.add_(1.0)
    update.step()
    for name, before in old.items():
        moved = loss.target_encoder_params[("module", *name.split("."))]
        torch.testing.assert_close(moved, 0.95 * before + 0.05 * (before + 1.0))


@pytest.mark.parametrize("first", ["sac", "contrastive"])
def test_it_trains_the_very_encoder_of_the_critic(first):
    actor, critic = make_ferm_actor(hidden=8, image_size=SIZE), make_critic()
    if first == "contrastive":
        contrastive, _ = make_loss(critic)
    sac = SACLoss(actor, critic)
    SoftUpdate(sac, tau=0.01)
    if first == "sac":
        contrastive, _ = make_loss(critic)
    values = dict(sac.qvalue_network_params.items(True, True))
    of_sac = {key[3:]: value for key, value in values.items() if key[:2] == ("module", "0")}
    of_ours = dict(contrastive.encoder_params.items(True, True))
    assert {key[1:] for key in of_ours} == set(of_sac)
    for key, parameter in of_ours.items():
        assert parameter is of_sac[key[1:]], key
    # The encoder's and W, no others: neither heads nor targets.
    assert {id(p) for p in contrastive.parameters()} == {
        id(p) for p in (*critic.module[0].parameters(), contrastive.similarity)
    }

    before = {key: value.detach().clone() for key, value in values.items()}
    optimizer = torch.optim.Adam(contrastive.parameters(), lr=1e-3)
    contrastive(crops())["loss_contrastive"].backward()
    optimizer.step()
    for key, value in sac.qvalue_network_params.items(True, True):
        assert torch.equal(value, before[key]) == (key[1] == "1"), key
    assert torch.isfinite(sac(transitions(4, SIZE))["loss_qvalue"])


def test_it_learns_which_crops_belong_together():
    loss, update = make_loss(make_critic())
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    scenes = random_observations(BATCH, SIZE + 2)["depth"]
    data = crops()
    data["depth"], data["positive"] = scenes[..., :-2, 1:-1], scenes[..., 1:-1, 2:]
    results = []
    for _ in range(80):
        results.append(loss(data))
        optimizer.zero_grad()
        results[-1]["loss_contrastive"].backward()
        optimizer.step()
        update.step()
    assert results[-1]["loss_contrastive"] < 0.1 < results[0]["loss_contrastive"]
    assert results[-1]["contrastive_accuracy"] == 1


def test_keys_are_read_by_name_and_the_input_is_left_alone():
    loss, _ = make_loss(make_critic())
    assert loss.in_keys == ["depth", "holding", "positive"]
    data = crops()
    expected = loss(data)
    assert set(expected.keys()) == set(loss.out_keys)
    assert set(data.keys()) == {"depth", "holding", "positive"}
    assert all(torch.equal(data[key], crops()[key]) for key in data.keys())  # noqa: SIM118
    with pytest.raises(KeyError, match="positive"):
        loss(data.exclude("positive"))
    loss.set_keys(positive=("other", "crop"))
    data.rename_key_("positive", ("other", "crop"))
    assert torch.equal(loss(data)["loss_contrastive"], expected["loss_contrastive"])


def test_state_dict_restores_encoder_keys_and_similarity():
    loss, update = make_loss(make_critic())
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.mul_(1.1)
    update.step()
    other = ContrastiveLoss(make_ferm_critic(hidden=8, image_size=SIZE).module[0])
    SoftUpdate(other, tau=TAU)
    assert other(crops())["loss_contrastive"] != loss(crops())["loss_contrastive"]
    other.load_state_dict(loss.state_dict())
    assert torch.equal(other(crops())["loss_contrastive"], loss(crops())["loss_contrastive"])


def test_similarity_starts_as_curls_and_is_reproducible():
    critic = make_critic()
    first, second, other = (
        ContrastiveLoss(critic.module[0], generator=torch.Generator().manual_seed(seed)).similarity
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, second) and not torch.equal(first, other)
    assert first.shape == (50, 50) and first.min() >= 0 and first.max() < 1
    assert abs(first.mean() - 0.5) < 0.02


def test_what_is_no_encoder_is_refused():
    critic = make_critic()
    with pytest.raises(TypeError, match="must be a TensorDictModule .* got CenterCropped"):
        ContrastiveLoss(critic.module[0].module)
    with pytest.raises(ValueError, match="features=0"):
        ContrastiveLoss(critic.module[0], features=0)
    loss = ContrastiveLoss(critic.module[0], features=49)
    SoftUpdate(loss, tau=TAU)
    with pytest.raises(ValueError, match=r"features of shape \(B, 49\) .* got \(6, 50\)"):
        loss(crops())
