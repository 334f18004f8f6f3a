"""Layers shared by frame and history encoders."""

import warnings

from torchrl_tit.layers.attention import RelativeSelfAttention, SelfAttention, attention_maps
from torchrl_tit.layers.blocks import GatedTransformerBlock, GPT2Block, GRUGate, TransformerBlock
from torchrl_tit.layers.initialization import init_normal_, init_orthogonal_
from torchrl_tit.layers.patches import ArrayPatchEmbedding, ImagePatchEmbedding
from torchrl_tit.layers.positions import RelativeBias, Rotary
from torchrl_tit.layers.standardize import standardize

# TorchRL's losses call two critics with torch.vmap. PyTorch's attention kernel for CPUs then runs
# once per critic, as without vmap; PyTorch warns about this.
warnings.filterwarnings("ignore", "There is a performance drop", module=r"torchrl_tit\.layers\.")

__all__ = [
    "ArrayPatchEmbedding",
    "GPT2Block",
    "GRUGate",
    "GatedTransformerBlock",
    "ImagePatchEmbedding",
    "RelativeBias",
    "RelativeSelfAttention",
    "Rotary",
    "SelfAttention",
    "TransformerBlock",
    "attention_maps",
    "init_normal_",
    "init_orthogonal_",
    "standardize",
]
