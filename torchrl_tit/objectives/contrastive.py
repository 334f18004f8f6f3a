"""The contrastive loss of CoBERL, which TorchRL lacks."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F


def contrastive_prediction_loss(
    encodings: Tensor,
    predictions: Tensor,
    mask: Tensor,
    padding: Tensor | None = None,
    *,
    temperature: float = 0.1,
) -> Tensor:
    r"""Contrasts the predictions of masked steps with the encodings of all steps of a batch.

    With x the predictions, y the encodings and s their cosine similarity divided by the
    temperature, the loss of a masked step t is

    .. math::

        -\log \frac{e^{s(x_t, y_t)}}{\sum_i e^{s(x_t, y_i)}}
        -\log \frac{e^{s(y_t, x_t)}}{\sum_i e^{s(y_t, x_i)}}
        + \mathrm{KL}(\mathrm{sg}\,p(\cdot | y_t) \,\|\, p(\cdot | x_t))

    where p are the two softmaxes over the steps i of all histories, and sg stops the gradient. The
    last term makes the two distributions agree. Banino et al. (arXiv 2107.05431, section 2.1)
    publish no code: the temperature, the cosine and the equal weight of the three terms are our
    choices.

    Args:
        encodings: y, float [N, K, D], see :func:`~torchrl_tit.networks.masked_predictions`.
        predictions: x, float [N, K, D].
        mask: bool [N, K], True where a step was masked.
        padding: bool [N, K], True where a history repeats a step or has none; it counts neither as
            a masked step nor among the steps i. Histories should not share steps either: the
            copies of a step are told apart from it, which cannot succeed.
        temperature: divides the similarities.

    Returns:
        The mean over the masked steps, float []; 0 if none is masked.

    Raises:
        ValueError: if shapes or the mask's dtype do not match, or the temperature is not positive.

    Example:
        >>> encodings, mask = torch.eye(6).view(2, 3, 6), torch.tensor([[True, False, False]] * 2)
        >>> right = contrastive_prediction_loss(encodings, encodings, mask)
        >>> wrong = contrastive_prediction_loss(encodings, encodings.flip(0), mask)
        >>> bool(right < 0.01 < wrong)
        True
    """
    # By hand, since what checked_arguments adds cannot be compiled.
    if not 0 < temperature < math.inf:
        raise ValueError(f"temperature must be positive, not {temperature}")
    if not encodings.shape == predictions.shape or mask.shape != encodings.shape[:2]:
        raise ValueError(
            f"encodings and predictions must be [N, K, D] and mask [N, K], not "
            f"{list(encodings.shape)}, {list(predictions.shape)} and {list(mask.shape)}"
        )
    if mask.dtype != torch.bool:
        raise ValueError(f"mask must be bool, not {mask.dtype}")
    if padding is None:
        padding = torch.zeros_like(mask)
    if padding.dtype != torch.bool or padding.shape != mask.shape:
        raise ValueError(
            f"padding must be bool {list(mask.shape)}, not {padding.dtype} {list(padding.shape)}"
        )
    x = F.normalize(predictions.flatten(0, 1), dim=-1)  # [N * K, D]
    y = F.normalize(encodings.flatten(0, 1), dim=-1)
    similarity = x @ y.T / temperature  # [N * K, N * K]
    absent = padding.flatten()
    least = torch.finfo(similarity.dtype).min  # infinity would make the divergence NaN
    similarity = similarity.masked_fill(absent | absent.unsqueeze(-1), least)
    log_p_x, log_p_y = similarity.log_softmax(-1), similarity.T.log_softmax(-1)
    agreement = F.kl_div(log_p_x, log_p_y.detach(), reduction="none", log_target=True).sum(-1)
    loss = agreement - log_p_x.diagonal() - log_p_y.diagonal()  # [N * K]
    masked = mask.flatten() & ~absent
    # Selecting rows would make shapes depend on the data, which cannot be compiled.
    return torch.where(masked, loss, 0).sum() / masked.sum().clamp(min=1)
