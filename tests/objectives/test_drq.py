"""DrQ's shifts and averages, against plain computations."""

import copy

import pytest
import torch
import torch.nn.functional as F

from equirl.objectives import DrQfDLoss, DrQLoss, SACfDLoss, SACLoss, random_shift
from tests.objectives.plain import (
    ALPHA,
    BATCH,
    LOSSES,
    SIZE,
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

SHIFT = 2


def plain_shift(images, largest, generator):
    """Pads by replication and crops, one image after the other."""
    rows, columns = torch.randint(-largest, largest + 1, (2, len(images), 1), generator=generator)
    size, shifted = images.shape[-1], []
    for image, row, column in zip(images, rows.flatten(), columns.flatten(), strict=True):
        padded = F.pad(image[None], [largest] * 4, mode="replicate")[0]
        top, left = largest + int(row), largest + int(column)
        shifted.append(padded[:, top : top + size, left : left + size])
    return torch.stack(shifted)


def plain_losses(actor, critic, data, views, targets, *, demonstrated, weights, seed=5):
    """Losses over M shifted copies, targets over K, one copy after the other."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(7)
    count, target_critic = len(data), target_of(critic)
    seen = plain_shift(torch.cat([data["depth"]] * views), SHIFT, generator)
    after = plain_shift(torch.cat([data["next", "depth"]] * targets), SHIFT, generator)
    with torch.no_grad():
        holding = torch.cat([data["next", "holding"]] * targets)
        action, log_prob = sample(actor, after, holding)
        target = torch.zeros(count, dtype=torch.double)
        for k in range(targets):
            rows = slice(k * count, (k + 1) * count)
            q = judge(target_critic, after[rows], holding[rows], action[rows])
            value = q.min(-1).values - ALPHA * log_prob[rows]
            target += bootstrap(data, value) / targets
    holding = torch.cat([data["holding"]] * views)
    action, log_prob = sample(actor, seen, holding)
    frozen = copy.deepcopy(critic).requires_grad_(False)
    losses = dict.fromkeys(("loss_actor", "loss_qvalue", "loss_alpha"), 0.0)
    losses |= {"loss_demonstration": 0.0} if demonstrated else {}
    td_error = torch.zeros(count, dtype=torch.double)
    for m in range(views):
        rows = slice(m * count, (m + 1) * count)
        state = seen[rows], data["holding"]
        errors = judge(critic, *state, data["action"]) - target[:, None]
        losses["loss_qvalue"] += (weights[:, None] * errors.pow(2)).mean(0).sum() / views
        td_error += errors.detach().abs().mean(-1) / views
        q = judge(frozen, *state, action[rows]).min(-1).values
        losses["loss_actor"] += (ALPHA * log_prob[rows] - q).mean() / views
        gap = log_prob[rows].detach() + TARGET_ENTROPY
        losses["loss_alpha"] -= (torch.tensor(ALPHA).log() * gap).mean() / views
        if demonstrated:
            squared = (action[rows] - data["action"])[data["expert"].squeeze(-1)] ** 2
            losses["loss_demonstration"] += 0.5 * squared.mean() / views
    return losses | {"td_error": td_error}


@pytest.mark.parametrize(
    ("demonstrated", "weighted"), [(False, False), (True, False), (True, True)]
)
@pytest.mark.parametrize(("views", "targets"), [(2, 2), (1, 3), (3, 1)])
def test_drq_equals_a_plain_computation(views, targets, demonstrated, weighted):
    ours, plain = networks()
    kind = DrQfDLoss if demonstrated else DrQLoss
    generator = torch.Generator().manual_seed(7)
    loss = kind(
        *ours,
        target_views=targets,
        loss_views=views,
        shift=SHIFT,
        generator=generator,
        **LOSSES,
    )
    set_apart(loss)
    data = batch()
    weights = torch.ones(BATCH, dtype=torch.double)
    if weighted:
        weights = data["priority_weight"] = torch.linspace(0.1, 1, BATCH, dtype=torch.double)
    torch.manual_seed(5)
    losses = loss.backward(data)
    options = {"demonstrated": demonstrated, "weights": weights}
    expected = plain_losses(*plain, batch(), views, targets, **options)
    sum(value for name, value in expected.items() if name.startswith("loss_")).backward()
    assert set(losses.keys()) == set(loss.out_keys)
    assert_same_losses(dict(losses) | {"td_error": data["td_error"]}, expected)
    assert_same_gradients(ours, plain)


@pytest.mark.parametrize(("kind", "base"), [(DrQLoss, SACLoss), (DrQfDLoss, SACfDLoss)])
def test_one_copy_without_a_shift_is_the_loss_it_averages(kind, base):
    ours, _ = networks()
    options = {"generator": torch.Generator(), **LOSSES}  # the global one draws the actions
    drq = kind(*ours, target_views=1, loss_views=1, shift=0, **options)
    plain = base(*copy.deepcopy(ours), **LOSSES)
    for loss in (drq, plain):
        set_apart(loss)
    torch.manual_seed(0)
    result = drq(batch())
    torch.manual_seed(0)
    assert_same_losses(result, dict(plain(batch())))


def test_the_batch_is_left_as_it_was_but_for_the_td_error():
    ours, _ = networks()
    loss = DrQLoss(*ours, shift=SHIFT, **LOSSES)
    set_apart(loss)
    data = batch()
    loss(data)
    assert data["td_error"].shape == (BATCH,)
    for key, value in batch().items(True, True):
        assert torch.equal(data[key], value), key


def test_shifts_cover_every_displacement_of_rows_and_columns_alike():
    image = torch.arange(SIZE * SIZE, dtype=torch.float).reshape(1, 1, SIZE, SIZE)
    generator = torch.Generator().manual_seed(0)
    shifted = random_shift(image.expand(4000, -1, -1, -1), SHIFT, generator)
    middle = shifted[:, 0, SIZE // 2, SIZE // 2].long() - SIZE * SIZE // 2 - SIZE // 2
    rows = torch.div(middle + SIZE // 2, SIZE, rounding_mode="floor")
    columns = middle - rows * SIZE
    for displacement in (rows, columns):
        share = torch.bincount(displacement + SHIFT, minlength=2 * SHIFT + 1) / 4000
        torch.testing.assert_close(share, torch.full((5,), 0.2), rtol=0, atol=0.03)
    assert abs(torch.corrcoef(torch.stack([rows, columns]).float())[0, 1]) < 0.06
    border = random_shift(image, SIZE, generator)  # what comes in is the border's pixel
    assert set(border.flatten().tolist()) <= set(image.flatten().tolist())


@pytest.mark.parametrize(
    ("name", "value"), [("target_views", 0), ("loss_views", 1.5), ("shift", -1)]
)
def test_numbers_out_of_range_are_refused(name, value):
    ours, _ = networks()
    with pytest.raises(ValueError, match=f"{name}={value}: expected an integer"):
        DrQLoss(*ours, **{name: value})
