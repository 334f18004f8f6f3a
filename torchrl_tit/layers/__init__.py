"""Layers shared by frame and history encoders."""

import warnings

from torchrl_tit.layers.attention import SelfAttention
from torchrl_tit.layers.block import TransformerBlock
from torchrl_tit.layers.dropout import Dropout
from torchrl_tit.layers.gated_block import GatedTransformerBlock, GRUGate
from torchrl_tit.layers.gpt2_block import GPT2Block
from torchrl_tit.layers.initialization import (
    init_normal_,
    init_orthogonal_,
)
from torchrl_tit.layers.patches import ArrayPatchEmbedding, ImagePatchEmbedding
from torchrl_tit.layers.positions import RelativeBias, Rotary
from torchrl_tit.layers.relative_attention import RelativeSelfAttention
from torchrl_tit.layers.standardize import standardize

# TorchRL's losses call two critics with torch.vmap. PyTorch's attention kernel for CPUs, and
# dropout, then run once per critic, as without vmap; PyTorch warns about this.
warnings.filterwarnings("ignore", "There is a performance drop", module=r"torchrl_tit\.layers\.")

__all__ = [
    "ArrayPatchEmbedding",
    "Dropout",
    "GPT2Block",
    "GRUGate",
    "GatedTransformerBlock",
    "ImagePatchEmbedding",
    "RelativeBias",
    "RelativeSelfAttention",
    "Rotary",
    "SelfAttention",
    "TransformerBlock",
    "init_normal_",
    "init_orthogonal_",
    "standardize",
]
