"""The SAC loss against a plain, independent computation."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.objectives import SACLoss as TorchRLSACLoss
from torchrl.objectives import SoftUpdate

from equirl.modules import make_actor, make_critic
from equirl.objectives import SACLoss
from tests.transitions import transitions

GAMMA, ALPHA, TARGET_ENTROPY, TAU = 0.9, 0.05, -5.0, 0.1
SIZE, BATCH = 16, 6


def batch() -> TensorDict:
    return transitions(BATCH, SIZE)


def networks(mode: str = "strict", group: str = "D4"):
    generator = torch.Generator().manual_seed(1)
    size = {"hidden": 8, "image_size": SIZE, "mode": mode, "generator": generator}
    return make_actor(group, **size), make_critic(group, **size)


def make_loss(actor, critic) -> SACLoss:
    loss = SACLoss(actor, critic, alpha_init=ALPHA, target_entropy=TARGET_ENTROPY, gamma=GAMMA)
    SoftUpdate(loss, tau=TAU)
    return loss


def plain_losses(actor, critic, target_critic, log_alpha, data, seed):
    """SAC as in the paper, with plain module calls and torch's global generator."""
    torch.manual_seed(seed)
    alpha = log_alpha.detach().exp()
    with torch.no_grad():
        following = data["next"].select("depth", "holding")
        action, log_prob = actor.get_dist(following).rsample_and_log_prob()
        q = target_critic(following.set("action", action))["state_action_value"]
        value = q.min(-1).values - alpha * log_prob
        live = 1 - data["next", "terminated"].float().squeeze(-1)
        target = data["next", "reward"].squeeze(-1) + GAMMA * live * value
    state = data.select("depth", "holding")
    q = critic(state.copy().set("action", data["action"]))["state_action_value"]
    errors = q - target.unsqueeze(-1)
    loss_qvalue = (errors[:, 0] ** 2).mean() + (errors[:, 1] ** 2).mean()
    action, log_prob = actor.get_dist(state.copy()).rsample_and_log_prob()
    frozen = copy.deepcopy(critic).requires_grad_(False)
    q = frozen(state.copy().set("action", action))["state_action_value"]
    loss_actor = (alpha * log_prob - q.min(-1).values).mean()
    loss_alpha = (-log_alpha * (log_prob.detach() + TARGET_ENTROPY)).mean()
    return {
        "loss_actor": loss_actor,
        "loss_qvalue": loss_qvalue,
        "loss_alpha": loss_alpha,
        "alpha": alpha,
        "entropy": -log_prob.mean(),
        "td_error": errors.abs().mean(-1),
    }


@pytest.mark.parametrize(
    ("mode", "group"), [("strict", "D4"), ("paper", "D4"), ("strict", "O2"), ("paper", "SO2")]
)
def test_losses_and_gradients_equal_a_plain_computation(mode, group):
    actor, critic = networks(mode, group)
    plain_actor, plain_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    plain_target = copy.deepcopy(critic)
    loss = make_loss(actor, critic)
    # A target that differs from the critic, or a mix-up of the two would go unseen.
    with torch.no_grad():
        for ours, plain in zip(
            loss.target_qvalue_network_params.values(True, True, sort=True),
            TensorDict.from_module(plain_target).values(True, True, sort=True),
            strict=True,
        ):
            if isinstance(plain, torch.nn.Parameter):  # and not a constant buffer
                plain.mul_(1.3)
                ours.data.mul_(1.3)
    log_alpha = torch.tensor(math.log(ALPHA), requires_grad=True)

    data = batch()
    torch.manual_seed(5)
    losses = loss(data)
    (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
    expected = plain_losses(plain_actor, plain_critic, plain_target, log_alpha, batch(), 5)
    sum(value for name, value in expected.items() if name.startswith("loss")).backward()

    written = dict(losses) | {"td_error": data["td_error"]}
    assert written.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(written[name], value, rtol=1e-5, atol=1e-6)
    for ours, plain in ((actor, plain_actor), (critic, plain_critic)):
        for (name, p), q in zip(ours.named_parameters(), plain.parameters(), strict=True):
            assert q.grad.abs().max() > 0, name
            torch.testing.assert_close(p.grad, q.grad, rtol=1e-4, atol=1e-6, msg=name)
    torch.testing.assert_close(loss.log_alpha.grad, log_alpha.grad, rtol=1e-5, atol=1e-6)


def test_each_loss_reaches_only_its_own_parameters():
    actor, critic = networks()
    loss = make_loss(actor, critic)
    targets = [p for p in loss.target_qvalue_network_params.values(True, True)]
    for name, trained in (("loss_actor", actor), ("loss_qvalue", critic), ("loss_alpha", None)):
        loss.zero_grad()
        loss(batch())[name].backward()
        for module in (actor, critic):
            touched = any(p.grad is not None and p.grad.any() for p in module.parameters())
            assert touched == (module is trained), (name, type(module))
        assert (loss.log_alpha.grad is not None) == (name == "loss_alpha")
        assert all(p.grad is None for p in targets)


def test_backward_is_forward_and_one_backward_pass():
    actor, critic = networks()
    together, apart = make_loss(actor, critic), make_loss(*copy.deepcopy((actor, critic)))
    torch.manual_seed(3)
    expected = together(batch())
    sum(expected[f"loss_{name}"] for name in ("actor", "qvalue", "alpha")).backward()
    torch.manual_seed(3)
    data = batch()
    losses = apart.backward(data)
    for key in together.out_keys:
        torch.testing.assert_close(losses[key], expected[key])
    assert data["td_error"].shape == (BATCH,)
    for (name, a), b in zip(together.named_parameters(), apart.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, msg=name)
    assert apart(batch())["loss_qvalue"].requires_grad  # forward is unchanged by it


def test_encoder_runs_once_for_state_and_once_for_target():
    actor, critic = networks()
    calls = []
    critic.module[0].module.register_forward_hook(lambda *_: calls.append(1))
    make_loss(actor, critic)(batch())
    assert len(calls) == 2


def test_truncation_bootstraps_and_termination_does_not():
    """The value of the last observation counts after a time-out only."""
    loss = make_loss(*networks())
    data = batch()
    data["next", "reward"] += 10  # targets above the values of both heads
    errors = []
    for shift in (0.0, 0.1):
        torch.manual_seed(0)
        changed = data.clone()
        changed["next", "depth"] += shift
        loss(changed)
        errors.append(changed["td_error"])
    moved = (errors[0] - errors[1]).abs() > 1e-7
    assert not moved[0] and moved[1]  # row 0 terminated, row 1 was truncated


def test_same_value_as_torchrl_with_two_separate_critics():
    """With no shared encoder, TorchRL's own loss is the reference."""

    class Head(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.mlp = torch.nn.Sequential(
                torch.nn.Linear(8, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)
            )

        def forward(self, state, action):
            return self.mlp(torch.cat([state, action], -1))

    class Both(torch.nn.Module):
        def __init__(self, heads):
            super().__init__()
            self.heads = torch.nn.ModuleList(heads)

        def forward(self, state, action):
            return torch.cat([head(state, action) for head in self.heads], -1)

    torch.manual_seed(0)
    actor, _ = networks()
    first, second = Head(), Head()
    pool = torch.nn.AdaptiveAvgPool2d(1)

    def encode(depth, holding):
        return torch.cat([pool(depth).flatten(1), holding, depth[:, 0, 0, :1]], -1)

    def encoder():
        return TensorDictModule(encode, ["depth", "holding"], ["features"])

    def stock_critic(head):
        module = TensorDictModule(head, ["features", "action"], ["state_action_value"])
        return TensorDictSequential(encoder(), module)

    heads = TensorDictModule(
        Both([copy.deepcopy(first), copy.deepcopy(second)]),
        ["features", "action"],
        ["state_action_value"],
    )
    ours = make_loss(copy.deepcopy(actor), TensorDictSequential(encoder(), heads))
    stock = TorchRLSACLoss(
        actor,
        [stock_critic(first), stock_critic(second)],
        loss_function="l2",
        alpha_init=ALPHA,
        target_entropy=TARGET_ENTROPY,
        deactivate_vmap=True,
    )
    stock.make_value_estimator(gamma=GAMMA)
    SoftUpdate(stock, tau=TAU)
    torch.manual_seed(2)
    result = ours(batch())
    torch.manual_seed(2)
    expected = stock(batch())
    for name in ("loss_actor", "loss_qvalue", "loss_alpha"):
        torch.testing.assert_close(result[name], expected[name], rtol=1e-5, atol=1e-6)


def test_a_critic_of_another_form_is_refused():
    actor, critic = networks()
    with pytest.raises(TypeError, match="a TensorDictSequential of two modules"):
        SACLoss(actor, critic.module[1])
    for number in ({"gamma": 2.0}, {"target_entropy": float("nan")}, {"alpha_init": 0.0}):
        with pytest.raises(ValueError, match="expected gamma in"):
            SACLoss(actor, critic, **number)
