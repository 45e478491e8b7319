"""The contrastive loss of CURL and FERM: which two crops are of one observation?"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from equirl.modules import FERM_FEATURES

__all__ = ["ContrastiveLoss"]


class ContrastiveLoss(LossModule):
    """Contrastive loss of an encoder on two crops of each observation.

    As in CURL (Srinivas et al., 2020), which FERM (Zhan et al., 2020; appendix E) takes over: of
    each observation s_i of a batch there are two crops, the query x_i and the positive x'_i. With
    f the encoder, f' the momentum encoder (the target parameters, which a
    `torchrl.objectives.SoftUpdate` with tau 0.05 moves) and W a learned matrix,

    * queries and keys:          q_i = f(x_i),  k_j = f'(x'_j), the latter held fixed;
    * similarities:              l_ij = q_i^T W k_j;
    * ``loss_contrastive``     = -mean_i log (exp l_ii / sum_j exp l_ij);
    * ``contrastive_accuracy`` = mean_i [argmax_j l_ij = i].

    CURL first takes each row's maximum off the similarities; it cancels in the quotient, and the
    cross-entropy used here does as much by itself.

    Like CURL's, the elements of W start uniform in [0, 1). Their mean of 1/2 alone says nothing:
    it multiplies the sums of q and k, which the encoder's layer norm makes zero at first. What
    is left is random, so that the loss starts above a guess's. A multiple of the identity was seen
    to learn sooner; the baseline stays as published.

    Args:
        encoder: Observation to features, its first in_key that of the image: ``critic.module[0]``
            of the critic whose encoder is to be trained. The parameters are shared with it, not
            copied, and with a `SACLoss` of that critic.
        features: Length of the encoder's features.
        generator: Source of W, on the CPU; torch's global one if None.

    Attributes:
        similarity: W, of shape (features, features).

    Forward:
        Takes a tensordict of batch size (B,) with the encoder's in_keys, the image being the first
        crop, and the other crop under ``positive`` (`set_keys` renames it); the rest of the
        observation goes with both crops. Returns one of the scalars ``loss_contrastive`` and,
        detached, ``contrastive_accuracy``. Writes nothing into its input.

    Raises:
        TypeError: The encoder is no TensorDictModule.
        ValueError: ``features`` is not a positive integer or, in a forward pass, not the length of
            the encoder's features.
    """

    @dataclass
    class _AcceptedKeys:
        """The key of the second crop."""

        positive: NestedKey = "positive"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys  # type: ignore[assignment]
    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModule,
        *,
        features: int = FERM_FEATURES,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        if not isinstance(encoder, TensorDictModule):
            raise TypeError(
                "the encoder must be a TensorDictModule from an observation to features, such as "
                f"critic.module[0] of make_ferm_critic; got {type(encoder).__name__}"
            )
        if not isinstance(features, int) or features < 1:
            raise ValueError(f"features={features!r}: expected a positive integer")
        self.convert_to_functional(encoder, "encoder", create_target_params=True)
        self.out_keys = ["loss_contrastive", "contrastive_accuracy"]
        similarity = torch.rand(features, features, generator=generator)
        self.similarity = nn.Parameter(similarity.to(next(encoder.parameters())))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The encoder's, and that of the second crop."""
        return [*self.encoder.in_keys, self.tensor_keys.positive]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of a batch, see the class."""
        data = tensordict.select(*self.in_keys)  # a copy: features are written into it
        query = self._encode(data, self.encoder_params)
        data.set(self.encoder.in_keys[0], data.get(self.tensor_keys.positive))
        with torch.no_grad():
            key = self._encode(data, self.target_encoder_params)
        logits = query @ self.similarity @ key.T
        labels = torch.arange(len(logits), device=logits.device)
        accuracy = (logits.argmax(-1) == labels).to(logits.dtype).mean()
        return TensorDict(
            {
                "loss_contrastive": F.cross_entropy(logits, labels),
                "contrastive_accuracy": accuracy,
            }
        )

    def _encode(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        with params.to_module(self.encoder, preserve_module_state=False):
            features = self.encoder(tensordict).get(self.encoder.out_keys[0])
        if features.shape[1:] != self.similarity.shape[:1]:
            raise ValueError(
                f"expected features of shape (B, {len(self.similarity)}) from the encoder, got "
                f"{tuple(features.shape)}"
            )
        return features
