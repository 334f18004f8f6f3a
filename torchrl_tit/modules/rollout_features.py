"""Features of whole rollouts, for which each frame is encoded once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor, nn

from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.frames import as_words, same_frames
from torchrl_tit.networks import HistoryNetwork


def add_rollout_features(
    rollout: TensorDictBase, backbone: Backbone, *, chunk_size: int = 256
) -> TensorDictBase:
    """Writes the features of all states and next states of a rollout, for value estimation.

    K histories in a row share frames. Each frame is encoded once, not K times, and the tokens of a
    history are picked from those. Which frames are the same is found by comparing them byte by byte
    with their neighbours in time, so resets, paddings and cut trajectories need no care. A next
    state that is the state one step later gets the features of that one. The features are those of
    ``backbone(rollout)`` and ``backbone(rollout["next"])``, within rounding.

    Then ``critic(rollout)`` and ``critic(rollout["next"])`` write what TorchRL's
    :class:`~torchrl.objectives.value.GAE` reads with ``value_network=None``.

    Args:
        rollout: [*batch, T], time last, with the histories [..., K, *observation_shape] under the
            backbone's key and under the same key in "next".
        backbone: the backbone, in evaluation mode (dropout would be drawn once a frame).
        chunk_size: frames, and histories, that go through the network at once.

    Returns:
        The rollout, with the backbone's ``out_keys``, and the same in "next".

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> from torchrl_tit.envs import make_env
        >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), history=8))
        >>> rollout = make_env("CartPole-v1", 2, history=8).rollout(50, break_when_any_done=False)
        >>> rollout = add_rollout_features(rollout, backbone)
        >>> rollout["features"].shape, rollout["next", "features"].shape
        (torch.Size([2, 50, 64]), torch.Size([2, 50, 64]))
    """
    (key,) = backbone.in_keys
    time = rollout.batch_dims - 1
    network = backbone.module
    frame_ndim = 1 + len(network.observation_shape)
    # Time goes beside the steps of a history: [*leading, T, K, *obs].
    windows = rollout.get(key).movedim(time, -frame_ndim - 1)
    following = rollout.get(unravel_key(("next", key))).movedim(time, -frame_ndim - 1)
    leading = windows.shape[: -frame_ndim - 1]
    windows = windows.reshape(-1, *windows.shape[-frame_ndim - 1 :])  # [N, T, K, *obs]
    following = following.reshape(windows.shape)

    words, following_words = as_words(windows.flatten(3)), as_words(following.flatten(3))
    ends = torch.ones_like(words[..., 0, 0], dtype=torch.bool)  # [N, T]: step t + 1 is no next one
    ends[:, :-1] = ~same_frames(following_words[:, :-1], words[:, 1:]).all(-1)
    histories = [windows.flatten(0, 1), following[ends]]  # [N * T, K, *obs], [E, K, *obs]

    with backbone.computing(windows.device):
        if isinstance(network, HistoryNetwork) and network.frame_encoder is not None:
            network.check(windows)
            sources = _sources(words, following_words[ends], ends)  # [N * T + E, K]
            tokens, index = _encode_each_once(network.frame_encoder, histories, sources, chunk_size)
            results = [network.encode_history(tokens[chunk]) for chunk in index.split(chunk_size)]
        else:
            results = [network(chunk) for x in histories for chunk in x.split(chunk_size)]
    # Networks with separate trunks put out several features.
    outputs = [(result,) if isinstance(result, Tensor) else result for result in results]

    for out_key, parts in zip(backbone.out_keys, zip(*outputs, strict=True), strict=True):
        together = torch.cat(parts)
        if backbone.autocast is not None:
            together = together.float()
        features, of_ends = together.split([len(x) for x in histories])
        features = features.view(*ends.shape, -1)  # [N, T, F]
        of_next = features.roll(-1, dims=1)
        of_next[ends] = of_ends
        shape = (*leading, *features.shape[1:])
        rollout.set(out_key, features.view(shape).movedim(-2, time))
        rollout.set(unravel_key(("next", out_key)), of_next.view(shape).movedim(-2, time))
    return rollout


def _sources(words: Tensor, end_words: Tensor, ends: Tensor) -> Tensor:
    """Finds for every frame of every history one with the same bytes that stands for it.

    Args:
        words: of the frames of the histories, int [N, T, K, words].
        end_words: of the frames of the next histories of E steps, int [E, K, words].
        ends: which steps these are, bool [N, T].

    Returns:
        int64 [N * T + E, K], indices into the frames of all these histories. A frame that stands
        for others stands for itself.
    """
    index = torch.arange(words[..., 0].numel(), device=words.device).view(words.shape[:-1])
    end_index = index.numel() + torch.arange(end_words[..., 0].numel(), device=words.device)
    end_index = end_index.view(end_words.shape[:-1])

    source = index.clone()
    older, newer = source[..., :-1], index[..., 1:]  # step k of a history, and step k + 1
    # Of a frame: the next one of its history, or better the one that it was a step ago.
    repeated = same_frames(words[..., :-1, :], words[..., 1:, :])
    older[repeated] = newer[repeated]
    moved = same_frames(words[:, 1:, :-1], words[:, :-1, 1:])
    older[:, 1:][moved] = newer[:, :-1][moved]
    end_source = end_index.clone()
    moved = same_frames(end_words[:, :-1], words[ends][:, 1:])
    end_source[:, :-1][moved] = newer[ends][moved]

    sources = torch.cat([source.flatten(0, 1), end_source])  # [N * T + E, K]
    flat = sources.flatten()
    # Each source stands a step later in its history, so K - 1 hops lead to the last one.
    for _ in range((words.shape[2] - 1).bit_length()):
        flat = flat[flat]
    return flat.view(sources.shape)


def _encode_each_once(
    encoder: nn.Module, histories: Sequence[Tensor], sources: Tensor, chunk_size: int
) -> tuple[Tensor, Tensor]:
    """Encodes the frames that stand for others and for themselves.

    Args:
        encoder: the frame encoder.
        histories: [M1, K, *observation_shape], [M2, K, *observation_shape], ...
        sources: what stands for each of their frames, int64 [M1 + M2 + ..., K].
        chunk_size: frames to encode at once.

    Returns:
        Tokens float [P, L, D], and where among them those of the histories are, int64 [M, K].
    """
    distinct = sources.flatten() == torch.arange(sources.numel(), device=sources.device)
    parts = distinct.view(sources.shape).split([len(x) for x in histories])
    frames = torch.cat([x[part] for x, part in zip(histories, parts, strict=True)])
    tokens = torch.cat([encoder(chunk) for chunk in frames.split(chunk_size)])
    return tokens, (distinct.cumsum(0) - 1)[sources]
