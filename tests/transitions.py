"""Random transitions, as they are stored."""

import torch
from tensordict import TensorDict


def transitions(count: int, image_size: int = 16, seed: int = 0) -> TensorDict:
    """Returns transitions of which the first ends in success and the second for want of time.

    (x, y) of the actions have length 1, so that no rotation takes them out of their box.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(count, *shape, generator=generator)

    def observation() -> dict[str, torch.Tensor]:
        return {"depth": 0.32 * uniform(1, image_size, image_size), "holding": uniform(1).round()}

    row = torch.arange(count).unsqueeze(-1)
    ends = {"done": row < 2, "terminated": row == 0, "truncated": row == 1}
    direction = torch.nn.functional.normalize(uniform(2) - 0.5, dim=-1)
    gripper, z, theta = (2 * uniform(3) - 1).split(1, -1)
    return TensorDict(
        {
            **observation(),
            "action": torch.cat([gripper, direction, z, theta], -1),
            "expert": torch.zeros(count, 1, dtype=torch.bool),
            "next": observation() | {"reward": uniform(1)} | ends,
        },
        [count],
    )
