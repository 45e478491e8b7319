"""SACfD, importance weights and ensembles of heads, against plain computations."""

import copy

import pytest
import torch

from equirl.objectives import SACfDLoss, SACLoss, demonstration_loss
from tests.objectives.plain import (
    ALPHA,
    BATCH,
    LOSSES,
    TARGET_ENTROPY,
    assert_same_gradients,
    assert_same_losses,
    batch,
    bootstrap,
    judge,
    networks,
    sample,
    set_apart,
    target_of,
)


def plain_losses(actor, critic, data, *, weights=None, experts=(), seed=5, pair=None):
    """SACfD as in SPEC: sums and loops over rows, torch's global generator for actions."""
    torch.manual_seed(seed)
    target_critic = target_of(critic)
    with torch.no_grad():
        following = data["next", "depth"], data["next", "holding"]
        action, log_prob = sample(actor, *following)
        q = judge(target_critic, *following, action)
        q = q if pair is None else q[:, pair]
        target = bootstrap(data, q.min(-1).values - ALPHA * log_prob)
    state = data["depth"], data["holding"]
    errors = judge(critic, *state, data["action"]) - target[:, None]
    weights = torch.ones(BATCH, dtype=torch.double) if weights is None else weights
    loss_qvalue = sum(
        weights[row] * errors[row, head] ** 2 / BATCH
        for row in range(BATCH)
        for head in range(errors.shape[1])
    )
    action, log_prob = sample(actor, *state)
    q = judge(copy.deepcopy(critic).requires_grad_(False), *state, action)
    q = q.min(-1).values if pair is None else q.mean(-1)
    demonstration = torch.zeros((), dtype=torch.double)
    for row in experts:
        for component in range(5):
            gap = action[row, component] - data["action"][row, component]
            demonstration = demonstration + 0.5 * gap**2 / (5 * len(experts))
    return {
        "loss_actor": (ALPHA * log_prob - q).mean(),
        "loss_qvalue": loss_qvalue,
        "loss_alpha": -(torch.tensor(ALPHA).log() * (log_prob.detach() + TARGET_ENTROPY)).mean(),
        "loss_demonstration": demonstration,
        "td_error": errors.abs().mean(-1),
    }


def total(losses):
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


@pytest.mark.parametrize("weight", [1.0, 2.0])
@pytest.mark.parametrize("experts", [2, 0, BATCH])
def test_sacfd_equals_a_plain_computation(weight, experts):
    ours, plain = networks()
    loss = SACfDLoss(*ours, demonstration_weight=weight, **LOSSES)
    set_apart(loss)
    data = batch(experts)
    torch.manual_seed(5)
    losses = loss.backward(data)
    expected = plain_losses(*plain, batch(experts), experts=range(BATCH - experts, BATCH))
    expected["loss_demonstration"] = weight * expected["loss_demonstration"]
    total(expected).backward()
    assert set(loss.out_keys) == set(losses.keys())
    assert_same_losses(dict(losses) | {"td_error": data["td_error"]}, expected)
    assert (losses["loss_demonstration"] > 0) == (experts > 0)
    assert_same_gradients(ours, plain)


def test_backward_is_forward_and_one_backward_pass():
    ours, _ = networks()
    together = SACfDLoss(*ours, **LOSSES)
    apart = SACfDLoss(*copy.deepcopy(ours), **LOSSES)
    for loss in (together, apart):
        set_apart(loss)
    torch.manual_seed(3)
    total(together(batch())).backward()
    torch.manual_seed(3)
    apart.backward(batch())
    for (name, a), b in zip(together.named_parameters(), apart.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, msg=name)


def test_demonstrations_pull_the_actor_only():
    (actor, critic), _ = networks()
    loss = SACfDLoss(actor, critic, **LOSSES)
    set_apart(loss)
    loss(batch())["loss_demonstration"].backward()
    assert any(p.grad is not None and p.grad.any() for p in actor.parameters())
    assert all(p.grad is None for p in critic.parameters())
    assert loss.log_alpha.grad is None


def test_the_term_leaves_out_what_no_expert_did():
    action, expert_action = torch.zeros(3, 2), torch.tensor([[2.0, 0], [9, 9], [0, 4]])
    expert = torch.tensor([[True], [False], [True]])
    assert demonstration_loss(action, expert_action, expert) == 0.5 * (4 + 16) / 4
    assert demonstration_loss(action, expert_action, torch.zeros(3, 1, dtype=bool)) == 0


@pytest.mark.parametrize("used", [True, False])
def test_importance_weights_weigh_the_critics_loss_alone(used):
    ours, plain = networks()
    loss = SACfDLoss(*ours, importance_weights=used, **LOSSES)
    set_apart(loss)
    weights = torch.linspace(0.1, 1, BATCH, dtype=torch.double)
    torch.manual_seed(5)
    losses = loss.backward(batch().set("priority_weight", weights))
    expected = plain_losses(
        *plain, batch(), weights=weights if used else None, experts=range(BATCH - 2, BATCH)
    )
    total(expected).backward()
    expected.pop("td_error")
    assert_same_losses(losses, expected)
    assert_same_gradients(ours, plain)


def test_of_many_heads_targets_take_two_and_the_actor_climbs_the_mean():
    ours, plain = networks(heads=5)
    loss = SACLoss(*ours, generator=torch.Generator().manual_seed(7), **LOSSES)
    set_apart(loss)
    pair = torch.randperm(5, generator=torch.Generator().manual_seed(7))[:2]
    data = batch()
    torch.manual_seed(5)
    losses = loss.backward(data)
    expected = plain_losses(*plain, batch(), pair=pair)
    expected.pop("loss_demonstration")
    total(expected).backward()
    assert_same_losses(dict(losses) | {"td_error": data["td_error"]}, expected)
    assert_same_gradients(ours, plain)


def test_a_weight_that_is_none_is_refused():
    ours, _ = networks()
    with pytest.raises(ValueError, match="demonstration_weight=-1"):
        SACfDLoss(*ours, demonstration_weight=-1)
