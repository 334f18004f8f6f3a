"""TorchRL's LSTM as a backbone: it remembers the whole episode instead of reading a history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Unbounded
from torchrl.envs import Compose, InitTracker, TensorDictPrimer
from torchrl.modules import LSTMModule

from torchrl_tit.networks.config import check_positive, override_config
from torchrl_tit.networks.history_network import make_head
from torchrl_tit.networks.two_trunks import check_array

_STATE = ["recurrent_state_h", "recurrent_state_c"]


@dataclass(frozen=True, kw_only=True)
class LSTMConfig:
    """Hyperparameters of the recurrent backbone."""

    embed_dim: int = 64
    """Width of the tanh layer on an observation, before the LSTM."""
    hidden_dim: int = 64
    """Size of the LSTM's state."""
    features_dim: int = 64
    """Size of the features that the network puts out."""

    def __post_init__(self) -> None:
        check_positive(self, "embed_dim", "hidden_dim", "features_dim")

    def make_transforms(self) -> Compose:
        """Builds what an environment needs for the state to go from step to step.

        Returns:
            TorchRL's `InitTracker`, which says where an episode begins, and `TensorDictPrimer`,
            which puts a state of zeros there.
        """
        spec = Unbounded(shape=(1, self.hidden_dim))  # layers, state
        primer = TensorDictPrimer({key: spec.clone() for key in _STATE}, expand_specs=True)
        return Compose(InitTracker(), primer)


class LSTMBackbone(TensorDictSequential):
    """Reads the newest observation and the state before it; writes features and the new state.

    A tanh layer, TorchRL's `LSTMModule`, and a head as TIT has it (LayerNorm, linear, tanh,
    LayerNorm): small observations, of positions say, hardly move the state, and the head's
    LayerNorm makes that readable. The state stands in the tensordict, so environments,
    collectors and checkpoints carry it like an observation: it begins at zero with an episode and
    goes on to its end. Step by step by default; within ``torchrl.modules.set_recurrent_mode(True)``
    the last batch dimension is time: then it runs over whole sequences, each from the state that
    its first step holds, and begins anew where an episode does.

    ==========================================  ==================  ================================
    key                                         shape               what it is
    ==========================================  ==================  ================================
    ``history``                                 [..., 1, D]         in: the newest observation
    ``recurrent_state_h``, ``..._c``            [..., 1, H]         in: the state before it
    ``is_init``                                 [..., 1]            in: bool, an episode begins
    ``features``                                [..., F]            out
    ``("next", "recurrent_state_h")``, ...      [..., 1, H]         out: the state after it
    ==========================================  ==================  ================================

    Args:
        observation_shape: (D,).
        history: 1: the state is the memory.
        config: hyperparameters.
        **hyperparameters: fields of :class:`LSTMConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not arrays, ``history`` is not 1, or a hyperparameter is not
            possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_tit.envs import make_env
        >>> config = LSTMConfig(hidden_dim=32)
        >>> env = TransformedEnv(make_env("CartPole-v1", num_envs=8), config.make_transforms())
        >>> backbone = LSTMBackbone(observation_shape=(4,), config=config)
        >>> td = backbone(env.reset())
        >>> td["features"].shape, td["next", "recurrent_state_h"].shape
        (torch.Size([8, 64]), torch.Size([8, 1, 32]))
    """

    keeps_frames = False
    """There are no earlier frames to keep the tokens of; see :class:`Backbone`."""

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: LSTMConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        check_array(observation_shape, history, single=True)
        config = override_config(LSTMConfig, config, hyperparameters)
        embedding = nn.Sequential(
            nn.Flatten(-2),  # [..., 1, D] -> [..., D]
            nn.Linear(observation_shape[0], config.embed_dim),
            nn.Tanh(),
        )
        lstm = LSTMModule(
            config.embed_dim,
            config.hidden_dim,
            in_keys=["embedding", *_STATE],
            out_keys=["memory", *(("next", key) for key in _STATE)],
        )
        super().__init__(
            TensorDictModule(embedding, ["history"], ["embedding"]),
            lstm,
            TensorDictModule(
                make_head(config.hidden_dim, config.features_dim, "tanh"), ["memory"], ["features"]
            ),
        )
        self.config = config
        self.features_dim = config.features_dim
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises the LSTM: orthogonal weights, biases 0; the other layers have their own."""
        for name, parameter in self[1].lstm.named_parameters():
            if name.startswith("weight"):
                nn.init.orthogonal_(parameter)
            else:
                nn.init.zeros_(parameter)
