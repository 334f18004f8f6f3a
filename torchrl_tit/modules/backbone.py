"""The backbone: a network of this library as a TensorDictModule.

Which call encodes what::

    backbone(td)                     as TorchRL calls it: one of the next two, by its recurrent mode
      encode_steps(td)               steps [*B]: the K frames of each history; with a recurrent
                                     network, the newest frame and the state
        within acting()              ... the newest frame only: the tokens of the others are kept
                                     (acting.py, frame_cache.py)
      encode_sequences(td)           sequences [*B, T]: each frame once; makes a table of their
                                     frames (sequences.py, frame_tables.py), and calls
        encode_windows(frames, windows)    each frame of a table once; also for batches that are
                                           tables already, as those of recipes and replay buffers
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key_list
from tensordict.nn import dispatch, skip_existing
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, InitTracker, TensorDictPrimer, Transform
from torchrl.modules import set_recurrent_mode

from torchrl_tit.histories.encoder import RecurrentEncoder
from torchrl_tit.modules.acting import ActingModule, trunks_of
from torchrl_tit.modules.sequences import (
    SequenceKeys,
    beside,
    default_observation_keys,
    step_episodes,
)
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.networks.history_network import weights_dtype
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Padding
from torchrl_tit.windows import Windows


class Backbone(ActingModule):
    """Reads histories and writes features, for any TorchRL head, loss or collector.

    Put one backbone in front of all heads. They read its features, so the network runs once per
    step in collection and once per minibatch in training, however many heads and losses there are.

    The histories of consecutive steps share K - 1 frames. Within :meth:`acting`, only the newest
    frame is encoded at each step, and the features are the same.

    A recurrent network (an LSTM with one frame) reads its state from the tensordict, and writes the
    next state along with the features:

    ==========================================  ==================  ================================
    key                                         shape               what it is
    ==========================================  ==================  ================================
    ``history``                                 [..., 1, *obs]      read: the newest observation
    ``recurrent_state_h``, ``..._c``            [..., 1, H]         read: the state before it
    ``is_init``                                 [..., 1]            read: bool, first step of an
                                                                    episode
    ``features``                                [..., F]            written
    ``("next", "recurrent_state_h")``, ...      [..., 1, H]         written: the state after it
    ==========================================  ==================  ================================

    The transforms of :meth:`make_transforms` supply the state and ``is_init``. With two trunks, the
    keys of the states begin with ``policy_`` and ``value_``.

    **Several agents.** Dimensions between those of the batch and those of a history stay as they
    are: histories [*B, agents, K, *obs] under ``("agents", "history")`` become features [*B,
    agents, F], and sequences [*B, T, agents, *obs] features [*B, T, agents, F]. All agents share
    the weights. ``is_init`` [*B, T, 1] is that of the environment.

    **Sequences.** By default a backbone reads single steps. Within TorchRL's recurrent mode
    (``torchrl.modules.set_recurrent_mode(True)``, which TorchRL's losses switch on) it reads
    sequences, if the tensordict has ``is_init``: the last batch dimension is time, and each frame
    is encoded once, not once for each of the K windows that contain it. The features are the same
    as those of single steps. A network with further inputs, or with ``every_frame``, reads its
    windows as ever. A recurrent network reads its state only at the first step of each
    sequence and at ``is_init`` (slices of a replay buffer, which have none, are arranged by
    :func:`~torchrl_tit.modules.as_sequences`); any other network reads:

    ==================  =====================  =====================================================
    key                 shape                  what it is
    ==================  =====================  =====================================================
    ``history``         [*B, T, K, *obs]       optional; read where a sequence begins, at t = 0,
                                               at ``is_init`` and after a step that is done (as
                                               TorchRL's `SliceSampler` marks the end of a slice);
                                               elsewhere the window is the last one, moved by one
    ``observation``     [*B, T, *obs]          the newest frame of each step
    ``is_init``         [*B, T, 1]             bool, first step of an episode
    ``features``        [*B, T, F]             written
    ``features_valid``  [*B, T, 1]             written without ``history``: bool, False at the first
                                               K - 1 steps of a sequence that begins inside an
                                               episode, whose windows would begin before it
    ==================  =====================  =====================================================

    Shuffled single steps are not sequences: leave out their ``is_init``, or call the backbone
    within ``set_recurrent_mode(False)``. `SliceSampler` sets ``is_init`` at the beginning of each
    slice, which is right with histories; without them, pass ``init_key=None`` to it. Compiled, a
    network that carries a state starts from zeros at each ``is_init``, whatever state is stored.
    Dropout in the frame encoder is drawn once per frame.

    Args:
        network: a :class:`~torchrl_tit.networks.HistoryNetwork`, which maps histories to features
            [..., F]; a :class:`~torchrl_tit.networks.TwoTrunks` of two such networks; or any other
            module that maps one tensor for each of ``in_keys`` to one for each of ``out_keys``.
        in_keys: keys, nested or not, of the history of each observation (see
            :class:`~torchrl_tit.transforms.History`), in the network's order, followed by those of
            the history encoder's further inputs. A single key can be given as a string. For several
            observations, :func:`~torchrl_tit.modules.history_keys` lists the keys.
        out_keys: keys of the features: one, or one for the policy and one for the value. A single
            key can be given as a string. By default "features"; beside ``("agents", "history")``,
            ``("agents", "features")``.
        autocast: dtype of matrix products, such as ``torch.bfloat16``; weights and features keep
            their dtype. None disables autocast.
        every_frame: write the features of all K frames, [..., K, F], for losses on whole windows,
            instead of those of the newest frame only. Two backbones, one for training and one for
            acting, can share a network.
        padding: what precedes an ``is_init`` in a sequence, as in
            :class:`~torchrl_tit.transforms.History`: its observation ("same") or zeros
            ("constant"). If given, only the histories at t = 0 are read, all shapes are static (for
            ``torch.compile`` and ``vmap``), and padding is encoded once. It is for sequences in
            which ``is_init`` marks every first observation: neither for flat slices, nor for the
            next steps of losses and GAE. If None, every history is read that does not continue the
            one before it; without histories, "same" is used.
        observation_keys: keys of the observations, one for each history; by default a history's
            key with "history" replaced by "observation". If these or ``padding`` are given, the
            ``in_keys`` include them and ``is_init``, for losses that select the ``in_keys``, and
            those of a recurrent network "sequence".

    Raises:
        ValueError: if the number of keys does not match the network's inputs and outputs,
            ``every_frame`` is set for a history encoder that only encodes the newest frame, the
            padding is unknown, or a state is to be carried for agents; in ``forward``, if steps are
            not consecutive, or the padding makes other histories than the stored ones.
        KeyError: in ``forward``, if the tensordict lacks one of the entries.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> tit = EnhancedTIT(observation_shape=(4,), num_frames=8, features_dim=32)
        >>> backbone = Backbone(tit, in_keys=["history"], out_keys=["features"])
        >>> backbone(TensorDict({"history": torch.randn(5, 8, 4)}, [5]))["features"].shape
        torch.Size([5, 32])
    """

    @checked_arguments
    def __init__(
        self,
        network: nn.Module,
        in_keys: Sequence[NestedKey] | str = ("history",),
        out_keys: Sequence[NestedKey] | str | None = None,
        autocast: torch.dtype | None = None,
        every_frame: bool = False,
        padding: Padding | None = None,
        observation_keys: Sequence[NestedKey] | str | None = None,
    ) -> None:
        in_keys = [in_keys] if isinstance(in_keys, str) else list(in_keys)
        first = in_keys[0] if in_keys else "history"
        # ("history", NAME) is one of several observations, whatever its name.
        of_agents = isinstance(first, tuple) and first[0] != "history" and "history" in first[-1]
        if out_keys is None:
            out_keys = [beside(first, "features") if of_agents else "features"]
        out_keys = [out_keys] if isinstance(out_keys, str) else list(out_keys)
        if not isinstance(network, nn.Module):
            raise ValueError(f"network must be one, such as EnhancedTIT((4,)), not {network!r}")
        trunks = trunks_of(network)
        _check_keys(network, trunks, in_keys, out_keys)
        if every_frame:
            _check_every_frame(network)
        state_shapes = {
            prefix + key: shape
            for prefix, trunk in trunks.items()
            for key, shape in _state_shapes(trunk).items()
        }
        if state_shapes and of_agents:
            raise ValueError(
                f"{type(network.history_encoder).__name__} of one frame carries a state for one "
                f"agent, not for those of {first!r}: give it num_frames of 2 or more"
            )
        sequence_keys, context = _sequence_keys(trunks, in_keys, observation_keys, padding)
        step_keys = [*in_keys, *state_shapes, *(["is_init"] if state_shapes else [])]
        declared = [*sequence_keys.observations, "is_init"] if padding or observation_keys else []
        declared += ["sequence"] if declared and state_shapes else []
        super().__init__(
            network,
            in_keys=[*step_keys, *(key for key in declared if key not in step_keys)],
            out_keys=[*out_keys, *(("next", key) for key in state_shapes)],
        )
        self._step_keys = step_keys  # keys that a single step reads
        # Others read windows as they are stored, or have a state.
        self._reads_sequences = not (context or every_frame or state_shapes)
        self.sequence_keys = sequence_keys
        """Keys of the entries read from sequences."""
        self.history_keys = in_keys
        """Keys of the histories, and of the history encoder's further inputs."""
        self.features_keys = out_keys
        """Keys of the features: one, or the policy's and the value's."""
        self.state_shapes = state_shapes
        """Shape of each entry of the recurrent state without batch dimensions, by key."""
        self.autocast = autocast
        self.every_frame = every_frame

    @dispatch(auto_batch_size=False)
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        tensordict_out: TensorDictBase | None = None,
        **unknown: Any,  # torch.export looks for it before it passes entries by keyword
    ) -> TensorDictBase:
        """Writes the features of the histories into the tensordict and returns it.

        As with every TensorDictModule, the entries can also be given by position or by keyword,
        instead of a tensordict; the outputs are then returned as tensors.
        """
        if unknown:
            raise TypeError(f"a backbone reads {self.in_keys}, but was given {sorted(unknown)}")
        if skip_existing() and all(key in tensordict.keys(True) for key in self.out_keys):
            return tensordict
        # A recurrent network reads sequences itself.
        if self.is_recurrent and tensordict.get("sequence", None) is not None:
            written = self._encode_arranged(tensordict["sequence"])
        elif self._reads_sequences and self.sequence_keys.in_sequence(tensordict):
            written = self.encode_sequences(tensordict)
        else:
            written = self.encode_steps(tensordict)
        return self._write_to_tensordict(
            tensordict, list(written.values()), tensordict_out, list(written)
        )

    def encode_steps(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Encodes single steps; within :meth:`acting`, only their newest frames.

        Args:
            tensordict: [*B], with the histories, and with its state if the network is recurrent
                (which within TorchRL's recurrent mode takes [*B, T], as an `LSTMModule` does).

        Returns:
            The features, and the next state, by key.

        Raises:
            KeyError: if an entry is missing.
        """
        tensors = [self._entry(tensordict, key) for key in self._step_keys]
        with self.computing(tensors[0].device):
            outputs = self._encode(tensors)
        return dict(zip(self.out_keys_source, self._in_full(outputs), strict=True))

    def encode_sequences(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Encodes sequences of consecutive steps, each frame once; not for recurrent networks.

        Args:
            tensordict: [*B, T], see the class's docstring.

        Returns:
            The features by key, and "features_valid" if there are no histories.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if the steps are not consecutive, or an entry does not fit the network.
        """
        trunks = list(trunks_of(self.module).values())
        table = self.sequence_keys.lay_out(tensordict, trunks)
        outputs = self.encode_windows(table.frames, table.windows)
        *batch, steps = self.sequence_keys.shape_of(tensordict)
        group = self.sequence_keys.group_of(tensordict, trunks)

        def unflatten(output: Tensor) -> Tensor:  # [N, T, ...] -> [*B, T, *group, ...]
            output = output.reshape(*batch, *group, steps, *output.shape[2:])
            return output.movedim(len(batch) + len(group), len(batch))

        written: dict[NestedKey, Tensor] = {
            key: unflatten(output) for key, output in zip(self.features_keys, outputs, strict=True)
        }
        if table.valid is not None:
            valid = beside(self.features_keys[0], "features_valid")
            written[valid] = unflatten(table.valid.unsqueeze(-1))
        return written

    def encode_windows(self, frames: Sequence[Tensor], windows: Windows) -> tuple[Tensor, ...]:
        """Maps windows on a table of frames to features, encoding each frame once.

        Args:
            frames: the table of each observation, [R, *observation_shape].
            windows: the rows of each window, [..., K].

        Returns:
            One tensor for each of ``features_keys``, float [..., F].
        """
        trunks = trunks_of(self.module).values()
        with self.computing(windows.rows.device):
            if trunks:
                outputs: Any = [trunk.encode_windows(frames, windows) for trunk in trunks]
            else:
                outputs = self.module(*(windows.gather(table) for table in frames))
        return self._in_full(outputs)

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuses other keys, because other attributes follow from them."""
        if name in ("in_keys", "out_keys") and f"_{name}" in vars(self):
            present, given = vars(self)[f"_{name}"], unravel_key_list(list(value))
            if given != present:
                raise AttributeError(
                    f"{name} of a backbone cannot be changed from {present} to {given}: build "
                    "another one of the same network, Backbone(backbone.module, in_keys, out_keys)"
                )
        super().__setattr__(name, value)

    @property
    def features_dim(self) -> int:
        """Size F of the features."""
        return self.module.features_dim

    @property
    def is_recurrent(self) -> bool:
        """Whether the network carries a state from step to step."""
        return bool(self.state_shapes)

    @property
    def keeps_frames(self) -> bool:
        """Whether acting mode saves work: frames are encoded, and histories have several."""
        return not self.every_frame and super().keeps_frames

    def make_transforms(self) -> Compose:
        """Builds the transforms that carry the recurrent state through an environment.

        Returns:
            TorchRL's `InitTracker`, which marks the first step of each episode, and
            `TensorDictPrimer`, which starts it with a state of zeros. Empty if the network is not
            recurrent.
        """
        transforms = [InitTracker(), self.make_tensordict_primer()] if self.is_recurrent else []
        return Compose(*transforms)

    def make_tensordict_primer(self) -> Transform:
        """Builds the transform that starts each episode with a state of zeros.

        TorchRL calls it for the environments of collectors (``auto_register_policy_transforms``)
        and in ``torchrl.modules.get_primers_from_module``.

        Returns:
            TorchRL's `TensorDictPrimer`; an empty `Compose` if the network is not recurrent.
        """
        if not self.is_recurrent:
            return Compose()
        dtype = weights_dtype(self.module)
        specs = {key: Unbounded(shape, dtype=dtype) for key, shape in self.state_shapes.items()}
        return TensorDictPrimer(specs, expand_specs=True)

    def computing(self, device: torch.device) -> AbstractContextManager[object]:
        """Returns the context in which matrix products have the dtype ``autocast``."""
        if self.autocast is None:
            return nullcontext()
        return torch.autocast(device.type, self.autocast)

    def _in_full(self, outputs: Tensor | Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Returns the outputs in the precision of the weights, which heads and losses need."""
        outputs = (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)
        if self.autocast is None:
            return outputs
        return tuple(x.to(weights_dtype(self.module)) for x in outputs)

    def _encode(self, tensors: Sequence[Tensor]) -> Any:
        if self.every_frame:
            return self.module.every_frame(*tensors)
        if self.is_recurrent:
            return self._step(tensors)
        return self._call_network(tensors)

    def _step(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Histories, state and is_init -> features and the next state."""
        count = len(self.history_keys)
        histories, is_init = tensors[:count], tensors[-1]
        before = dict(zip(self.state_shapes, tensors[count:-1], strict=True))
        trunks = trunks_of(self.module)
        states = [
            {key: before[prefix + key] for key in _state_shapes(trunk)}
            for prefix, trunk in trunks.items()
        ]
        compute = [
            lambda *x, trunk=trunk, state=state: step_episodes(trunk.step, x, state, is_init)
            for trunk, state in zip(trunks.values(), states, strict=True)
        ]
        outputs = self._call_trunks(histories, compute)
        outputs = [outputs] if len(trunks) == 1 else outputs
        after = {
            prefix + key: value
            for prefix, (_, state) in zip(trunks, outputs, strict=True)
            for key, value in state.items()
        }
        return (*(features for features, _ in outputs), *(after[key] for key in self.state_shapes))

    def _encode_arranged(self, sequence: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Encodes what :func:`~torchrl_tit.modules.as_sequences` arranged, [N, T], by key."""
        state: list[Tensor] | None = None
        if (burn_in := sequence.get("burn_in", None)) is not None:
            with torch.no_grad():
                _, state = self._read(burn_in[:, 0], None)
        features, _ = self._read(sequence["steps"][:, 0], state)
        position = sequence["position"]
        return {
            key: entries.gather(1, position.expand(-1, -1, entries.shape[-1]))
            for key, entries in zip(self.features_keys, features, strict=True)
        }

    def _read(
        self, steps: TensorDictBase, state: list[Tensor] | None
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Reads sequences [N, S] from a state -> features [N, S, F] and the state after them."""
        frames = [steps[key] for key in self.sequence_keys.observations]
        like: dict[str, Any] = {"device": frames[0].device, "dtype": weights_dtype(self.module)}
        is_init, states = steps["is_init"], []
        for index, shape in enumerate(self.state_shapes.values()):
            entry = torch.zeros(1, 1, *[1] * len(shape), **like).expand(*steps.shape, *shape)
            if state is not None:  # it is read where an episode begins, too, and is zero there
                first = state[index].masked_fill(is_init[:, 0].view(-1, *[1] * len(shape)), 0)
                entry = torch.cat([first.unsqueeze(1), entry[:, 1:]], dim=1)
            states.append(entry)
        histories = [x.unsqueeze(steps.ndim) for x in frames]
        with self.computing(is_init.device), set_recurrent_mode(True):
            outputs = self._in_full(self._step([*histories, *states, is_init]))
        count = len(self.features_keys)
        return list(outputs[:count]), [x[:, -1] for x in outputs[count:]]

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """Gets an entry; raises KeyError if it is missing."""
        if (entry := tensordict.get(key, None)) is not None:
            return entry
        kind, hint = "entry", "add backbone.make_transforms() to the environment, which supplies it"
        if key in self.history_keys:
            kind = "history"
            hint = (
                "add torchrl_tit.History to the environment (SequenceHistory for Decision "
                "Transformer), or name the key in in_keys"
            )
        raise KeyError(
            f"there is no {kind} under {key!r}, only {sorted(map(str, tensordict.keys(True)))}: "
            f"{hint}"
        )


def history_keys(observation: object) -> list[NestedKey]:
    """Names the histories of a task's observations: the ``in_keys`` of a backbone.

    Args:
        observation: the argument that builds a network: the shape or spec of the only observation,
            or those of several by name (a mapping or a ``Composite``), as
            :func:`~torchrl_tit.envs.observation_specs` returns them.

    Returns:
        ``"history"`` for the only observation, or ``("history", NAME)`` for each.

    Example:
        >>> history_keys((4,)), history_keys({"image": (3, 84, 84), "state": (4,)})
        (['history'], [('history', 'image'), ('history', 'state')])
    """
    if isinstance(observation, Mapping | Composite):
        return [("history", name) for name in observation.keys()]  # noqa: SIM118
    return ["history"]


def _sequence_keys(
    trunks: dict[str, HistoryNetwork],
    in_keys: list[NestedKey],
    observation_keys: Sequence[NestedKey] | str | None,
    padding: Padding | None,
) -> tuple[SequenceKeys, list[NestedKey]]:
    """Keys of the entries that a backbone reads from sequences, and those of further inputs."""
    count = max((len(trunk.frames) for trunk in trunks.values()), default=len(in_keys))
    histories, context = in_keys[:count], in_keys[count:]
    keys = default_observation_keys(histories) if observation_keys is None else observation_keys
    observations: list[NestedKey] = [keys] if isinstance(keys, str) else list(keys)
    return SequenceKeys(histories, observations, padding), context


def _state_shapes(network: HistoryNetwork) -> dict[str, torch.Size]:
    """Shapes of the state that a network carries from step to step."""
    encoder = network.history_encoder
    if network.carries_state and isinstance(encoder, RecurrentEncoder):
        return encoder.state_shapes
    return {}


def _check_every_frame(network: nn.Module) -> None:
    """Raises ValueError if the network cannot encode every frame of a window."""
    encoder = network.history_encoder if isinstance(network, HistoryNetwork) else network
    if not getattr(encoder, "encodes_every_frame", False):
        raise ValueError(
            f"every_frame=True, but {type(encoder).__name__} encodes the newest frame only: leave "
            "it out, or use a decision-transformer"
        )


def _check_keys(
    network: nn.Module,
    trunks: dict[str, HistoryNetwork],
    in_keys: Sequence[NestedKey],
    out_keys: Sequence[NestedKey],
) -> None:
    """Raises ValueError if the number of keys does not match the network's inputs and outputs."""
    reads, writes = max(1, len(in_keys)), max(1, len(out_keys))
    for trunk in trunks.values():
        reads = len(trunk.frames) + len(trunk.history_encoder.context)
        writes = len(trunks)
    if len(in_keys) != reads or len(out_keys) != writes:
        raise ValueError(
            f"{type(network).__name__} has {reads} inputs and {writes} outputs, but in_keys is "
            f"{list(in_keys)} and out_keys is {list(out_keys)}: name one key for each "
            "(torchrl_tit.modules.history_keys lists those of several observations)"
        )
