"""The core of this library: a frame encoder, then a history encoder, then a head."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.flat import Flat
from torchrl_tit.frames.observation import Observation, Observations, read_observations
from torchrl_tit.histories.encoder import HistoryShape, RecurrentEncoder, State
from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.images import bytes_to_floats
from torchrl_tit.layers.initialization import init_normal_
from torchrl_tit.networks.building import build_frames, build_history, module_names
from torchrl_tit.networks.by_kind import frames_by_kind
from torchrl_tit.settings.checks import checked
from torchrl_tit.settings.numbers import Frames
from torchrl_tit.windows import Windows


class HistoryNetwork(nn.Module):
    """Maps the last K observations to features: frame encoder, history encoder, head.

        history  [..., K, *observation_shape]
          frame encoder    -> tokens   [..., K, L, D]   one observation at a time, shared over time
          history encoder  -> outputs  [..., E]         what happened over the K frames
          head             -> features [..., F]

    Nothing flows from the history encoder back into the frame encoder, so the tokens of a frame
    depend on that frame alone (arXiv 2212.14538, appendix on information flow: "T-S" is 0).

    If there are several observations (pixels and a state, say), each has its own frame encoder, and
    their tokens are concatenated. ``observation_shape`` is then a mapping; ``frame`` is a mapping
    too, or settings that all share.

    Args:
        frame: settings of the frame encoder.
        history: settings of the history encoder.
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images; or TorchRL's spec of an
            observation, which is needed for categories (see
            :func:`~torchrl_tit.frames.read_observation`); or a mapping from names to these.
        num_frames: number K >= 1 of observations.
        head: settings of the head.
        initialization: "normal" initializes the weights as the authors of TIT do
            (:func:`~torchrl_tit.layers.init_normal_`), "default" keeps each layer's own
            initialization.
        action_dim: entries of an action, for history encoders that read actions.

    Raises:
        ValueError: if a setting is invalid, the two encoders do not fit each other, or a
            history of another shape is given to ``forward``.
        TypeError: if a history of another dtype is given to ``forward``.

    Example:
        >>> from torchrl_tit.settings import Inner, PairedOuter
        >>> network = HistoryNetwork(
        ...     Inner(patch_size=12), PairedOuter(), observation_shape=(84, 84), num_frames=16
        ... )
        >>> network(torch.zeros(2, 16, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 64])
    """

    def __init__(
        self,
        frame: settings.FrameSettings | Mapping[str, settings.FrameSettings],
        history: settings.HistorySettings,
        *,
        observation_shape: Observations,
        num_frames: int = 1,
        head: settings.Head | None = None,
        initialization: Literal["normal", "default"] = "default",
        action_dim: int | None = None,
    ) -> None:
        super().__init__()
        self.observations = read_observations(observation_shape)
        """The observations that the network reads, by name."""
        self.frame_settings = (
            dict(frame) if isinstance(frame, Mapping) else dict.fromkeys(self.observations, frame)
        )
        """The settings of each frame encoder, by the name of its observation."""
        parts = [(part, settings.FrameSettings) for part in self.frame_settings.values()]
        for part, kind in [*parts, (history, settings.HistorySettings)]:
            if not isinstance(part, kind):
                raise ValueError(
                    "a network is built from settings, such as Inner() and PairedOuter(), but "
                    f"{part!r} is no {kind.__name__}"
                )
        self.num_frames = checked("num_frames", num_frames, Frames)
        self.initialization = initialization
        encoders = build_frames(self.frame_settings, self.observations)
        self.frame_encoders = nn.ModuleDict(
            dict(zip(module_names(encoders), encoders.values(), strict=True))
        )
        self.history_encoder = build_history(
            history, _history_shape(encoders, num_frames, action_dim)
        )
        self.head, self.features_dim = _make_head(
            self.history_encoder.out_features, head or settings.Head()
        )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes as ``initialization`` says, after all layers have initialized themselves."""
        if self.initialization == "normal":
            init_normal_(self)

    def forward(self, *inputs: Tensor, compute: Callable[..., Any] | None = None) -> Any:
        """Maps histories to features.

        Args:
            *inputs: a history [..., K, *observation_shape] for each observation, the oldest frame
                first; uint8 (scaled to 0..1) or the network's own float type (used as is), and
                integers of categories. Then the other inputs of the history encoder
                (``history_encoder.context``).
            compute: maps these inputs to the output in another way, such as with tokens that it has
                kept. The hooks of this network are called as ever.

        Returns:
            float [..., F], or what ``compute`` returns.
        """
        if compute is not None:
            return compute(*inputs)
        count = len(self.frame_encoders)
        return self.encode_history(self.encode_frames(*inputs[:count]), *inputs[count:])

    def encode_frames(self, *histories: Tensor) -> Tensor:
        """Maps histories to tokens, [..., K, *observation_shape] each -> float [..., K, L, D]."""
        self.check(*histories)
        tokens = [encoder(history) for encoder, history in zip(self.frames, histories, strict=True)]
        return self.join_tokens(tokens)

    def join_tokens(self, tokens: Sequence[Tensor]) -> Tensor:
        """Concatenates the tokens of several observations, [..., L_i, D] each."""
        if len(tokens) == 1:
            return tokens[0]
        return torch.cat([self.as_floats(x) for x in tokens], dim=-2)

    def encode_history(self, tokens: Tensor, *context: Tensor) -> Tensor:
        """Maps the tokens of K frames to features, float [..., K, L, D] -> [..., F]."""
        return self.head(self.history_encoder(self.as_floats(tokens), *context))

    def encode_windows(self, frames: Sequence[Tensor], windows: Windows) -> Tensor:
        """Maps windows on a table of frames to features, encoding each frame once.

        Not for history encoders that read more than observations.

        The features and gradients are those of ``forward(*(windows.gather(x) for x in frames))``,
        up to rounding, at a cost that hardly grows with K. Dropout in the frame encoder is drawn
        once per frame, not once for each window that contains it.

        Args:
            frames: the table of each observation, [R, *observation_shape].
            windows: the rows of each window, [..., K].

        Returns:
            float [..., F].

        Example:
            >>> from torchrl_tit import EnhancedTIT
            >>> from torchrl_tit.windows import find_windows
            >>> tit, frames = EnhancedTIT((4,), num_frames=8), torch.randn(39, 4)
            >>> newest = torch.arange(7, 39)
            >>> windows = find_windows(newest, newest - 7, num_frames=8, padding="same")
            >>> tit.encode_windows([frames], windows).shape
            torch.Size([32, 64])
        """
        self.check_frames(*frames)
        if windows.missing is not None:  # the padding frame is encoded like any other
            last = frames[0].shape[0]
            frames = [torch.cat([x, torch.zeros_like(x[:1])]) for x in frames]
            rows = windows.rows.masked_fill(windows.missing, last)
            windows = windows._replace(rows=rows, missing=None)
        tokens = [encoder(x) for encoder, x in zip(self.frames, frames, strict=True)]
        table = self.join_tokens(tokens)
        shares = windows.rows.shape[-1] > 1  # else a frame is in one window only
        if shares and self.history_encoder.reads_tables(windows):
            return self.head(self.history_encoder.read_table(self.as_floats(table), windows))
        return self.encode_history(windows.gather(table))

    def every_frame(self, *inputs: Tensor) -> Tensor:
        """Maps histories to features of every frame, each from that frame and the ones before it.

        Only available if ``history_encoder.encodes_every_frame``.

        Args:
            *inputs: as in ``forward``.

        Returns:
            float [..., K, F].
        """
        count = len(self.frame_encoders)
        tokens = self.as_floats(self.encode_frames(*inputs[:count]))
        return self.head(self.history_encoder.every_frame(tokens, *inputs[count:]))

    def step(
        self, histories: Sequence[Tensor], state: State, is_init: Tensor
    ) -> tuple[Tensor, State]:
        """Reads the newest frame and the previous state; only for recurrent networks.

        Args:
            histories: [*B, 1, *observation_shape] each.
            state: the history encoder's state before the step.
            is_init: bool [*B, 1], True where an episode begins.

        Returns:
            Features, float [*B, F], and the state after the step.
        """
        assert isinstance(self.history_encoder, RecurrentEncoder)
        tokens = self.as_floats(self.encode_frames(*histories)).squeeze(-3)  # [*B, L, D]
        outputs, state = self.history_encoder.step(tokens, state, is_init)
        return self.head(outputs), state

    def as_floats(self, tokens: Tensor) -> Tensor:
        """Converts flat frames to floats: one-hot vectors, and bytes for encoders of tokens."""
        if tokens.dtype == torch.bool:
            return tokens.to(weights_dtype(self))
        if self.history_encoder.reads_frames:
            return tokens
        return bytes_to_floats(tokens, weights_dtype(self))

    def check(self, *histories: Tensor) -> None:
        """Raises ValueError or TypeError if histories do not fit this network."""
        for observation, history in self._zip_observations(histories):
            num_frames = self.num_frames
            if self.history_encoder.reads_any_length and history.ndim > len(observation.shape):
                num_frames = history.shape[-len(observation.shape) - 1]
            expected = (num_frames, *observation.shape)
            if tuple(history.shape[-len(expected) :]) != expected:
                raise ValueError(
                    f"a history of shape {tuple(history.shape)} does not fit this network: "
                    f"expected [..., {', '.join(map(str, expected))}], which is {num_frames} "
                    f"observations of shape {observation.shape}, oldest first (torchrl_tit.History "
                    "stacks them)"
                )
            _check_dtype(history, observation, weights_dtype(self))

    def check_frames(self, *frames: Tensor) -> None:
        """Raises ValueError or TypeError if tables of frames do not fit this network."""
        for observation, table in self._zip_observations(frames):
            if tuple(table.shape[1:]) != observation.shape:
                raise ValueError(
                    f"observations of shape {tuple(table.shape[1:])} do not fit this network: "
                    f"expected {observation.shape}"
                )
            _check_dtype(table, observation, weights_dtype(self))

    def _zip_observations(self, inputs: Sequence[Tensor]) -> Iterable[tuple[Observation, Tensor]]:
        if len(inputs) != len(self.observations):
            raise ValueError(
                f"this network reads {len(self.observations)} histories "
                f"({', '.join(self.observations)}), not {len(inputs)}"
            )
        return zip(self.observations.values(), inputs, strict=True)

    @property
    def keeps_frames(self) -> bool:
        """Whether caching tokens saves work: frames are encoded, and histories have several."""
        encodes = not all(isinstance(encoder, Flat) for encoder in self.frames)
        return encodes and self.num_frames > 1

    @property
    def carries_state(self) -> bool:
        """Whether the network carries a state between steps instead of reading several frames."""
        return self.history_encoder.is_recurrent and self.num_frames == 1

    @property
    def frames(self) -> list[FrameEncoder]:
        """The frame encoder of each observation."""
        return list(self.frame_encoders.values())  # type: ignore[arg-type]


class TwoTrunks(nn.Module):
    """Two separate networks on the same observations: one for the policy, one for values.

    Args:
        policy: the policy's network.
        value: the value's network.

    Example:
        >>> from torchrl_tit.networks import MLP
        >>> policy, value = MLP(observation_shape=(4,), num_frames=8)(torch.randn(16, 8, 4))
        >>> policy.shape, value.shape
        (torch.Size([16, 64]), torch.Size([16, 64]))
    """

    def __init__(self, policy: HistoryNetwork, value: HistoryNetwork) -> None:
        super().__init__()
        self.policy = policy
        self.value = value
        self.features_dim = policy.features_dim

    def forward(
        self, *histories: Tensor, compute: Sequence[Callable[..., Any] | None] = (None, None)
    ) -> tuple[Any, Any]:
        """Maps histories to features for the policy and for the value, float [..., F] each.

        Args:
            *histories: as in :meth:`HistoryNetwork.forward`.
            compute: that of the policy's network and that of the value's.
        """
        policy, value = compute
        return self.policy(*histories, compute=policy), self.value(*histories, compute=value)


def build_network(
    settings: settings.Network,
    observation: Observations,
    *,
    action_dim: int | None = None,
    trunks: str | None = None,
) -> HistoryNetwork | TwoTrunks:
    """Builds the network that settings describe.

    Args:
        settings: those of the network.
        observation: shape or spec of an observation, or of each by name if there are several.
        action_dim: entries of an action, for history encoders that read actions.
        trunks: "shared" builds one network even if the settings ask for two, for example for an
            actor with separate critics.

    Raises:
        ValueError: if the two encoders do not fit each other or the observation (see
            :func:`~torchrl_tit.networks.by_kind.frames_by_kind`, which chooses the frame encoders).

    Example:
        >>> from torchrl_tit.settings import NETWORKS
        >>> build_network(NETWORKS["enhanced-tit"](4), (4,))(torch.randn(2, 4, 4)).shape
        torch.Size([2, 64])
    """
    arguments = arguments_of(settings, observation, action_dim)
    if (trunks or settings.trunks) == "separate":
        return TwoTrunks(HistoryNetwork(**arguments), HistoryNetwork(**arguments))
    return HistoryNetwork(**arguments)


def arguments_of(
    settings: settings.Network, observation: Observations, action_dim: int | None = None
) -> dict[str, Any]:
    """Returns the arguments of :class:`HistoryNetwork` for a network that settings describe."""
    return {
        "frame": frames_by_kind(settings, observation),
        "history": settings.history,
        "observation_shape": observation,
        "num_frames": settings.num_frames,
        "head": settings.head,
        "initialization": settings.initialization,
        "action_dim": action_dim,
    }


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


def weights_dtype(network: nn.Module) -> torch.dtype:
    """Returns the float type of a network's weights; of one without weights, PyTorch's default.

    It does not use ``parameters()``, which is empty if TorchRL's losses have replaced parameters
    with plain tensors (target weights, a stack of critics).
    """
    names = ("weight", "weight_ih_l0")  # the second is an LSTM's, which may be the only layer
    # Asked at every step: in the head, a few layers, a weight is found several times faster.
    parts = (getattr(network, "head", network), network)
    weights = (getattr(x, name, None) for name in names for part in parts for x in part.modules())
    types = (weight.dtype for weight in weights if isinstance(weight, Tensor))
    return next(types, torch.get_default_dtype())


def _check_dtype(history: Tensor, observation: Observation, dtype: torch.dtype) -> None:
    if observation.categories is not None:
        if history.is_floating_point() or history.is_complex():
            raise TypeError(
                f"a history of {history.dtype} does not fit {observation}: give it integers that "
                "count from 0"
            )
        return
    device = history.device.type
    # Some devices, such as "meta", have no autocast.
    autocast = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    # Autocast converts every float type but double.
    fits = history.dtype == dtype or (
        autocast and history.is_floating_point() and history.dtype != torch.float64
    )
    if not fits and history.dtype != torch.uint8:
        hint = (
            f"give it {dtype} or uint8 (TorchRL's DTypeCastTransform converts it in an "
            f"environment), or convert the network with .to({history.dtype})"
        )
        if not history.is_floating_point():
            hint = (
                "if it counts categories, build the network with their spec (MultiCategorical) "
                "instead of their shape; else convert it to floats (TorchRL's DTypeCastTransform)"
            )
        raise TypeError(
            f"a history of {history.dtype} does not fit this network of {dtype}: {hint}"
        )


def _history_shape(
    encoders: Mapping[str, FrameEncoder], num_frames: int, action_dim: int | None
) -> HistoryShape:
    """Returns the input shape of the history encoder; raises if the token widths differ."""
    widths: dict[int, str] = {}
    for name, encoder in encoders.items():
        widths.setdefault(encoder.width, name)
    if len(widths) > 1:
        (width, name), (other_width, other), *_ = widths.items()
        raise ValueError(
            f"tokens of the widths {width} ({name}) and {other_width} ({other}) cannot stand side "
            "by side: give both frame encoders the same embed_dim (flat frames are as wide as "
            "their observation)"
        )
    first = next(iter(encoders.values()))
    return HistoryShape(
        num_frames=num_frames,
        num_tokens=sum(encoder.num_tokens for encoder in encoders.values()),
        width=first.width,
        frame_shape=first.frame_shape if len(encoders) == 1 and isinstance(first, Flat) else None,
        action_dim=action_dim,
    )


def _make_head(in_features: int, head: settings.Head) -> tuple[nn.Module, int]:
    """Builds the layers after the history encoder; returns them and the size of the features."""
    if head.features_dim is None:
        return nn.Identity(), in_features
    layers = [nn.Linear(in_features, head.features_dim), make_activation(head.activation)]
    if head.norm:
        layers = [nn.LayerNorm(in_features), *layers, nn.LayerNorm(head.features_dim)]
    return nn.Sequential(*layers), head.features_dim
