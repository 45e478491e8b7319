"""Soft actor-critic written out plainly, in float64, for the tests of what is built on it."""

import copy

import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from equirl.modules import make_cnn_actor, make_cnn_critic
from tests.transitions import transitions

GAMMA, ALPHA, TARGET_ENTROPY = 0.9, 0.05, -5.0
SIZE, BATCH = 16, 6
LOSSES = {"alpha_init": ALPHA, "target_entropy": TARGET_ENTROPY, "gamma": GAMMA}


def networks(heads: int = 2):
    """A plain convolutional actor and critic, and copies of them for the plain computation."""
    generator = torch.Generator().manual_seed(1)
    size = {"hidden": 8, "image_size": SIZE, "generator": generator}
    actor = make_cnn_actor(**size).double()
    critic = make_cnn_critic(**size, heads=heads).double()
    return (actor, critic), copy.deepcopy((actor, critic))


def batch(experts: int = 2, size: int = SIZE) -> TensorDict:
    """Transitions in float64, the last ones an expert's."""
    data = transitions(BATCH, size)
    data["expert"][BATCH - experts :] = True
    return data.apply(lambda value: value.double() if value.is_floating_point() else value)


def set_apart(loss, factor: float = 1.3) -> None:
    """Makes the target another than the critic, whose mix-up would go unseen."""
    SoftUpdate(loss, tau=0.1)
    for value in loss.target_qvalue_network_params.values(True, True):
        value.data.mul_(factor)


def target_of(critic, factor: float = 1.3):
    """The plain counterpart of `set_apart`."""
    target = copy.deepcopy(critic).requires_grad_(False)
    with torch.no_grad():
        for value in target.parameters():
            value.mul_(factor)
    return target


def sample(actor, depth, holding):
    """Actions and their log-probabilities, from torch's global generator."""
    observed = TensorDict({"depth": depth, "holding": holding}, [len(depth)])
    return actor.get_dist(observed).rsample_and_log_prob()


def judge(critic, depth, holding, action):
    """Values of actions, (B, heads)."""
    seen = TensorDict({"depth": depth, "holding": holding, "action": action}, [len(depth)])
    return critic(seen)["state_action_value"]


def bootstrap(data, value):
    """r + gamma (1 - terminated) value, (B,)."""
    live = 1 - data["next", "terminated"].double().squeeze(-1)
    return data["next", "reward"].squeeze(-1) + GAMMA * live * value


def assert_same_losses(losses, expected):
    """Compares losses within 1e-6; each expected one must be there."""
    for name, value in expected.items():
        _assert_close(losses[name], value, name)


def assert_same_gradients(modules, plain_modules):
    """Compares gradients within 1e-6; none may be absent or zero everywhere."""
    for ours, plain in zip(modules, plain_modules, strict=True):
        for (name, p), q in zip(ours.named_parameters(), plain.parameters(), strict=True):
            assert q.grad.abs().max() > 0, name
            _assert_close(p.grad, q.grad, name)


def _assert_close(ours, plain, name):
    def told(reason):
        return f"{name}: {reason}"

    torch.testing.assert_close(ours, plain, rtol=1e-6, atol=1e-8, msg=told)
