"""Networks: plain ``nn.Module``s, tensors in, tensors out."""

from torchrl_tit.networks.activations import Activation, make_activation
from torchrl_tit.networks.attention import SelfAttention
from torchrl_tit.networks.block import TransformerBlock
from torchrl_tit.networks.history_network import AttentionMaps, HistoryNetwork
from torchrl_tit.networks.initialization import init_normal_, init_orthogonal_
from torchrl_tit.networks.inner import InnerTransformer, LinearFrameEncoder
from torchrl_tit.networks.outer import PairedOuterTransformer, StackedOuterTransformer
from torchrl_tit.networks.patches import ArrayPatchEmbedding, ImagePatchEmbedding
from torchrl_tit.networks.tit import EnhancedTIT, VanillaTIT
from torchrl_tit.networks.tit_config import EnhancedTITConfig, TITConfig, VanillaTITConfig

__all__ = [
    "Activation",
    "ArrayPatchEmbedding",
    "AttentionMaps",
    "EnhancedTIT",
    "EnhancedTITConfig",
    "HistoryNetwork",
    "ImagePatchEmbedding",
    "InnerTransformer",
    "LinearFrameEncoder",
    "PairedOuterTransformer",
    "SelfAttention",
    "StackedOuterTransformer",
    "TITConfig",
    "TransformerBlock",
    "VanillaTIT",
    "VanillaTITConfig",
    "init_normal_",
    "init_orthogonal_",
    "make_activation",
]
