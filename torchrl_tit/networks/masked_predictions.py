"""The inputs of CoBERL's contrastive loss."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchrl_tit.networks.history_network import HistoryNetwork


def masked_predictions(
    network: HistoryNetwork, histories: Tensor | Sequence[Tensor], mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Encodes every frame, and predicts the encodings with the masked frames hidden.

    For :func:`~torchrl_tit.objectives.contrastive_prediction_loss` (arXiv 2107.05431, section 2.1).

    Args:
        network: a network whose history encoder has ``predict_masked``, such as CoBERL.
        histories: a history [..., K, *observation_shape], or one for each observation.
        mask: bool [..., K], True where a frame is hidden (15% of them in the paper).

    Returns:
        The encodings of the frames and their predictions, float [..., K, D] each.

    Raises:
        TypeError: if the history encoder cannot predict masked frames.

    Example:
        >>> import torch
        >>> from torchrl_tit.networks import CoBERL
        >>> network, history = CoBERL((20, 20), num_frames=4), torch.rand(2, 4, 20, 20)
        >>> encodings, predictions = masked_predictions(network, history, torch.rand(2, 4) < 0.15)
        >>> encodings.shape, predictions.shape
        (torch.Size([2, 4, 256]), torch.Size([2, 4, 256]))
    """
    predict_masked = getattr(network.history_encoder, "predict_masked", None)
    if predict_masked is None:
        raise TypeError(
            f"{type(network.history_encoder).__name__} cannot predict masked frames, which the "
            "contrastive loss compares: take coberl as the history encoder"
        )
    histories = [histories] if isinstance(histories, Tensor) else histories
    return predict_masked(network.as_floats(network.encode_frames(*histories)), mask)
