"""Random windows of sampled images."""

import pytest
import torch
from tensordict import TensorDict

from equirl.data import RandomCrop, make_replay_buffer
from tests.transitions import transitions


def numbered(rows: int, height: int, width: int) -> TensorDict:
    """Images whose pixels tell where they come from; those of the next observation are 0.5 more."""
    pixels = torch.arange(height * width, dtype=torch.float32).reshape(1, 1, height, width)
    depth = (1000 * torch.arange(rows)).reshape(-1, 1, 1, 1) + pixels
    return TensorDict({"depth": depth, "next": {"depth": depth + 0.5}}, [rows])


def corners(images: torch.Tensor, width: int) -> torch.Tensor:
    """Where the windows begin, (B, 2), and checks that they are windows of their own image."""
    size = images.shape[-1]
    first = images[:, 0, 0, 0] - 1000 * torch.arange(len(images))
    inside = width * torch.arange(size)[:, None] + torch.arange(size)
    assert torch.equal(
        images[:, 0] - images[:, 0, :1, :1], inside.float().expand(images[:, 0].shape)
    )
    return torch.stack([first // width, first % width], -1).long()


def test_windows_are_of_their_transition_and_all_equally_likely():
    crop = RandomCrop(8, generator=torch.Generator().manual_seed(0))
    batch = crop(numbered(3000, 10, 12))
    assert batch["depth"].shape == batch["next", "depth"].shape == (3000, 1, 8, 8)
    assert torch.equal(batch["next", "depth"], batch["depth"] + 0.5)  # one window a transition
    where = corners(batch["depth"], width=12)
    counts = torch.zeros(3, 5).index_put(tuple(where.T), torch.ones(3000), accumulate=True)
    assert ((counts - 200).pow(2) / 200).sum() < 36.1  # chi-square of 14, 0.1 %
    assert batch.get("positive", None) is None


def test_positives_are_windows_of_the_same_observation_drawn_on_their_own():
    crop = RandomCrop(8, positives=True, generator=torch.Generator().manual_seed(1))
    batch = crop(numbered(2000, 11, 11))
    first, second = (corners(batch[key], width=11) for key in ("depth", "positive"))
    assert abs((first == second).all(-1).float().mean() - 1 / 16) < 0.02
    assert abs(torch.corrcoef(torch.stack([first[:, 0], second[:, 0]]).float())[0, 1]) < 0.08
    assert torch.equal(batch["next", "depth"], batch["depth"] + 0.5)


@pytest.mark.parametrize(("size", "cropped"), [(142, 128), (72, 64), (18, 16), (16, 16)])
def test_cropping_is_done_at_sampling_only(size, cropped):
    stored, source = transitions(4, image_size=size), torch.Generator().manual_seed(0)
    buffer = make_replay_buffer(
        100,
        copies=0,
        augmentations=[RandomCrop(cropped, positives=True, generator=source)],
        batch_size=6,
        generator=source,
    )
    buffer.extend(stored)
    assert buffer.storage[:4]["depth"].shape == (4, 1, size, size)
    batch, again = buffer.sample(), buffer.sample()
    for key in ("depth", ("next", "depth"), "positive"):
        assert batch[key].shape == (6, 1, cropped, cropped) and batch[key].dtype == torch.float32
    windows = stored["depth"].unfold(2, cropped, 1).unfold(3, cropped, 1)
    for row in batch:
        candidates = windows[int(row["index"]), 0].flatten(0, 1)
        for key in ("depth", "positive"):
            assert (candidates - row[key]).abs().amax((1, 2)).min() < 1e-5
    assert not torch.equal(batch["depth"], again["depth"])


def test_bad_windows_are_named():
    with pytest.raises(ValueError, match=r"size=0: expected an integer of 1 or more"):
        RandomCrop(0)
    with pytest.raises(ValueError, match=r"16 x 16 pixels cannot be cropped to 18 x 18"):
        RandomCrop(18)(transitions(2))


def test_images_under_other_names_are_cropped_too():
    data = numbered(5, 10, 10)
    renamed = TensorDict({"pixels": data["depth"], "next": {"pixels": data["next", "depth"]}}, [5])
    seed = torch.Generator().manual_seed(0)
    batch = RandomCrop(8, in_keys=["pixels"], positives=True, generator=seed)(renamed)
    assert torch.equal(batch["next", "pixels"], batch["pixels"] + 0.5)
    assert batch["positive"].shape == batch["pixels"].shape == (5, 1, 8, 8)
