"""Hyperparameters of Decision Transformer, and the parts that they describe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torch import nn

from torchrl_tit.networks.activations import Activation
from torchrl_tit.networks.block import TransformerBlock
from torchrl_tit.networks.config import check_positive, check_probability
from torchrl_tit.networks.gaussian_head import GaussianHead
from torchrl_tit.networks.gpt2_block import GPT2Block
from torchrl_tit.networks.inner import InnerTransformer, LinearFrameEncoder


@dataclass(frozen=True, kw_only=True)
class DecisionTransformerConfig:
    """Hyperparameters of Decision Transformer, by default those of arXiv 2106.01345 for MuJoCo."""

    state_encoder: Literal["linear", "inner_transformer"] = "linear"
    """What makes a token of a state: a linear layer (DT), or an inner transformer (DT_TIT)."""
    action_space: Literal["continuous", "gaussian", "discrete"] = "continuous"
    """Continuous actions are predicted within -1..1 by a tanh, or by mean and standard deviation of
    a Gaussian that a tanh squashes (Online DT); discrete ones by logits."""
    embed_dim: int = 128
    """Width D of a token."""
    num_blocks: int = 3
    """Number of GPT-2 blocks."""
    num_heads: int = 1
    """Attention heads of a GPT-2 block; must divide the width."""
    ffn_dim: int | None = None
    """Hidden width of a GPT-2 block's FFN; four times the width where not given."""
    activation: Activation = "relu"
    """Activation in a GPT-2 block's FFN."""
    dropout: float = 0.1
    """Dropout on the tokens, on attention weights, and on the outputs of attention and FFN."""
    context: int = 20
    """Steps of a training window, and of the history while acting."""
    max_ep_len: int = 1000
    """Number of time steps that the timestep embedding knows, from 0."""
    timestep_embedding: bool = True
    """Whether tokens get a learned embedding of their time step (Online DT has none)."""
    patch_size: int | None = None
    """Patch of the inner transformer: entries, or pixels a side; the whole state if not given."""
    num_blocks_inner: int = 1
    """Number of inner blocks."""
    num_heads_inner: int = 1
    """Attention heads of an inner block; must divide the width."""
    ffn_expansion_inner: int = 1
    """Hidden width of an inner block's FFN as a multiple of the width."""
    activation_inner: Activation = "relu"
    """Activation in an inner block's FFN."""
    position_encoding: bool = False
    """Whether patches and class token of the inner transformer get a learned position encoding."""

    def __post_init__(self) -> None:
        choices = {
            "state_encoder": ("linear", "inner_transformer"),
            "action_space": ("continuous", "gaussian", "discrete"),
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise ValueError(f"unknown {name} {getattr(self, name)!r}: choose one of {known}")
        check_positive(
            self,
            "embed_dim",
            "num_blocks",
            "context",
            "max_ep_len",
            "num_blocks_inner",
            "ffn_expansion_inner",
        )
        for name in ("ffn_dim", "patch_size"):
            if getattr(self, name) is not None:
                check_positive(self, name)
        check_probability(self, "dropout")
        if self.context > self.max_ep_len:
            raise ValueError(
                f"a context of {self.context} steps is longer than max_ep_len {self.max_ep_len}: "
                "shorten it, or raise max_ep_len to the longest episode"
            )

    def make_state_encoder(self, observation_shape: Sequence[int]) -> nn.Module:
        """Builds the state encoder: [..., *observation_shape] -> [..., 1, D]."""
        if self.state_encoder == "linear":
            return LinearFrameEncoder(observation_shape, self.embed_dim, bias=True)
        return InnerTransformer(
            observation_shape,
            self.patch_size or observation_shape[-1],
            self.embed_dim,
            num_blocks=self.num_blocks_inner,
            make_block=lambda: TransformerBlock(
                self.embed_dim,
                self.num_heads_inner,
                ffn_expansion=self.ffn_expansion_inner,
                activation=self.activation_inner,
            ),
            every_block=False,
            position_encoding=self.position_encoding,
        )

    def make_action_head(self, action_dim: int) -> nn.Module:
        """Builds the head: [..., D] -> actions, logits, or mean and standard deviation [..., A]."""
        if self.action_space == "gaussian":
            return GaussianHead(self.embed_dim, action_dim)
        squash = nn.Tanh() if self.action_space == "continuous" else nn.Identity()
        return nn.Sequential(nn.Linear(self.embed_dim, action_dim), squash)

    def make_block(self) -> GPT2Block:
        """Builds a GPT-2 block."""
        return GPT2Block(
            self.embed_dim,
            self.num_heads,
            self.ffn_dim or 4 * self.embed_dim,
            activation=self.activation,
            dropout=self.dropout,
        )
