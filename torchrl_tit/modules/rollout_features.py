"""Features of whole rollouts, for which each frame is encoded once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor, nn

from torchrl_tit.modules.backbone import Backbone, trunks_of
from torchrl_tit.modules.same_bytes import as_words, same_frames
from torchrl_tit.networks import HistoryNetwork


def add_rollout_features(
    rollout: TensorDictBase, backbone: Backbone, *, chunk_size: int = 256
) -> TensorDictBase:
    """Writes the features of all states and next states of a rollout, for value estimation.

    Consecutive histories share K - 1 frames. Each frame is encoded once, not K times, and the
    tokens of every history are gathered from the result. Equal frames are found by comparing the
    bytes of neighbours in time, so resets, padding and trajectories that are cut off need no
    special treatment. A next state that is the state one step later gets the features of that one.
    The features are those of ``backbone(rollout)`` and ``backbone(rollout["next"])``, up to
    rounding.

    Then ``critic(rollout)`` and ``critic(rollout["next"])`` write what TorchRL's
    :class:`~torchrl.objectives.value.GAE` reads with ``value_network=None``.

    Args:
        rollout: [*batch, T], time last, with a history [..., K, *observation_shape] under each of
            the backbone's keys and under the same keys in "next".
        backbone: the backbone, in evaluation mode (dropout would be drawn once a frame).
        chunk_size: number of frames, and of histories, that are encoded at once.

    Returns:
        The rollout, with the backbone's ``out_keys``, and the same in "next".

    Raises:
        ValueError: if the backbone carries a state from step to step, or reads more than
            histories: call it on the rollout instead.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> from torchrl_tit.envs import make_env
        >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), num_frames=8))
        >>> env = make_env("CartPole-v1", 2, num_frames=8)
        >>> rollout = env.rollout(50, break_when_any_done=False)
        >>> rollout = add_rollout_features(rollout, backbone)
        >>> rollout["features"].shape, rollout["next", "features"].shape
        (torch.Size([2, 50, 64]), torch.Size([2, 50, 64]))
    """
    network = backbone.module
    trunks = list(trunks_of(network).values())
    if backbone.is_recurrent or any(trunk.history_encoder.context for trunk in trunks):
        raise ValueError(
            "add_rollout_features needs a backbone that reads histories alone, without a state or "
            "further entries; call the backbone on the rollout instead"
        )
    time = rollout.batch_dims - 1
    frame_ndims = _frame_ndims(rollout, backbone, trunks)
    states, next_states = [], []  # by key: [N, T, K, *obs]
    for key, ndim in zip(backbone.history_keys, frame_ndims, strict=True):
        # Time goes next to the frames of a history: [*leading, T, K, *obs].
        windows = rollout.get(key).movedim(time, -ndim - 2)
        following = rollout.get(unravel_key(("next", key))).movedim(time, -ndim - 2)
        leading = windows.shape[: -ndim - 2]
        states.append(windows.reshape(-1, *windows.shape[-ndim - 2 :]))
        next_states.append(following.reshape(states[-1].shape))

    words = [as_words(x.flatten(3)) for x in states]  # int [N, T, K, words]
    next_words = [as_words(x.flatten(3)) for x in next_states]
    ends = _ends(words, next_words)  # bool [N, T]: E steps
    histories = [  # by key: the states [N * T, K, *obs], and the next states [E, K, *obs]
        (x.flatten(0, 1), following[ends]) for x, following in zip(states, next_states, strict=True)
    ]

    with backbone.computing(states[0].device):
        if any(trunk.keeps_frames for trunk in trunks):
            sources = [_sources(x, y[ends], ends) for x, y in zip(words, next_words, strict=True)]
            outputs = tuple(_encode(trunk, histories, sources, chunk_size) for trunk in trunks)
        else:
            outputs = _call(network, histories, chunk_size)

    for out_key, output in zip(backbone.features_keys, outputs, strict=True):
        together = output.float() if backbone.autocast is not None else output
        features, of_ends = together.split([ends.numel(), len(together) - ends.numel()])
        features = features.view(*ends.shape, -1)  # [N, T, F]
        of_next = features.roll(-1, dims=1)
        of_next[ends] = of_ends
        shape = (*leading, *features.shape[1:])
        rollout.set(out_key, features.view(shape).movedim(-2, time))
        rollout.set(unravel_key(("next", out_key)), of_next.view(shape).movedim(-2, time))
    return rollout


def _frame_ndims(
    rollout: TensorDictBase, backbone: Backbone, trunks: Sequence[HistoryNetwork]
) -> list[int]:
    """The number of dimensions of an observation under each of the backbone's keys."""
    if trunks:
        return [len(encoder.observation_shape) for encoder in trunks[0].frames]
    # For other modules, only the rollout's own dimensions are known.
    return [rollout.get(key).ndim - rollout.batch_dims - 1 for key in backbone.history_keys]


def _ends(words: Sequence[Tensor], next_words: Sequence[Tensor]) -> Tensor:
    """Finds the steps whose next state is not the state one step later, bool [N, T]."""
    ends = torch.ones_like(words[0][..., 0, 0], dtype=torch.bool)
    ends[:, :-1] = False
    for x, following in zip(words, next_words, strict=True):
        ends[:, :-1] |= ~same_frames(following[:, :-1], x[:, 1:]).all(-1)
    return ends


def _sources(words: Tensor, end_words: Tensor, ends: Tensor) -> Tensor:
    """Finds for every frame of every history one with the same bytes that represents it.

    Args:
        words: of the frames of the histories, int [N, T, K, words].
        end_words: of the frames of the next histories of E steps, int [E, K, words].
        ends: which steps these are, bool [N, T].

    Returns:
        int64 [N * T + E, K], indices into the frames of all these histories. A frame that
        represents others represents itself.
    """
    index = torch.arange(words[..., 0].numel(), device=words.device).view(words.shape[:-1])
    end_index = index.numel() + torch.arange(end_words[..., 0].numel(), device=words.device)
    end_index = end_index.view(end_words.shape[:-1])

    source = index.clone()
    older, newer = source[..., :-1], index[..., 1:]  # frame k of a history, and frame k + 1
    # A frame's source is the next frame of its history or, better, the same frame a step ago.
    repeated = same_frames(words[..., :-1, :], words[..., 1:, :])
    older[repeated] = newer[repeated]
    moved = same_frames(words[:, 1:, :-1], words[:, :-1, 1:])
    older[:, 1:][moved] = newer[:, :-1][moved]
    end_source = end_index.clone()
    moved = same_frames(end_words[:, :-1], words[ends][:, 1:])
    end_source[:, :-1][moved] = newer[ends][moved]

    sources = torch.cat([source.flatten(0, 1), end_source])  # [N * T + E, K]
    flat = sources.flatten()
    # Each source is one frame later in its history, so K - 1 hops lead to the last one.
    for _ in range((words.shape[2] - 1).bit_length()):
        flat = flat[flat]
    return flat.view(sources.shape)


def _encode(
    network: HistoryNetwork,
    histories: Sequence[tuple[Tensor, ...]],
    sources: Sequence[Tensor],
    chunk_size: int,
) -> Tensor:
    """Encodes the frames that represent themselves, and all histories with their tokens.

    Args:
        network: the network.
        histories: of each observation, parts [M1, K, *observation_shape], [M2, K, ...].
        sources: of each observation, what represents each frame, int64 [M1 + M2, K].
        chunk_size: number of frames, and of histories, that are encoded at once.

    Returns:
        Features, float [M1 + M2, F].
    """
    network.check(*(parts[0] for parts in histories))
    tokens, places = [], []  # of each observation: [P, L, D], and int64 [M1 + M2, K]
    for encoder, parts, source in zip(network.frames, histories, sources, strict=True):
        distinct = source.flatten() == torch.arange(source.numel(), device=source.device)
        masks = distinct.view(source.shape).split([len(x) for x in parts])
        frames = torch.cat([x[mask] for x, mask in zip(parts, masks, strict=True)])
        tokens.append(torch.cat([encoder(chunk) for chunk in frames.split(chunk_size)]))
        places.append((distinct.cumsum(0) - 1)[source])
    features = []
    for rows in zip(*(place.split(chunk_size) for place in places), strict=True):
        gathered = [each[row] for each, row in zip(tokens, rows, strict=True)]  # [M, K, L, D]
        features.append(network.encode_history(torch.cat(gathered, dim=-2)))
    return torch.cat(features)


def _call(
    network: nn.Module, histories: Sequence[tuple[Tensor, ...]], chunk_size: int
) -> tuple[Tensor, ...]:
    """Calls a network on all histories; float [M1 + M2, F] for each of its outputs."""
    chunks = [
        chunk
        for parts in zip(*histories, strict=True)  # the states of each key, and the next states
        for chunk in zip(*(part.split(chunk_size) for part in parts), strict=True)
    ]
    results = [network(*chunk) for chunk in chunks]
    # Networks with separate trunks return several tensors.
    outputs = [(result,) if isinstance(result, Tensor) else result for result in results]
    return tuple(torch.cat(parts) for parts in zip(*outputs, strict=True))
