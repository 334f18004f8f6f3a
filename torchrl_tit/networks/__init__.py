"""Networks: plain ``nn.Module``s, tensors in, tensors out."""

from torchrl_tit.networks.activations import Activation, make_activation
from torchrl_tit.networks.attention import SelfAttention
from torchrl_tit.networks.block import TransformerBlock
from torchrl_tit.networks.catformer import Catformer, CatformerConfig, CatformerEncoder
from torchrl_tit.networks.coberl import CoBERL, CoBERLConfig, CoBERLEncoder
from torchrl_tit.networks.d2rl import D2RL, D2RLConfig
from torchrl_tit.networks.decision_transformer import DecisionTransformer
from torchrl_tit.networks.decision_transformer_config import DecisionTransformerConfig
from torchrl_tit.networks.dropout import Dropout
from torchrl_tit.networks.gated_transformer import GatedTransformerBlock, GRUGate
from torchrl_tit.networks.gaussian_head import ClampedGaussianHead, GaussianHead
from torchrl_tit.networks.gpt2_block import GPT2Block
from torchrl_tit.networks.history_network import AttentionMaps, HistoryNetwork
from torchrl_tit.networks.initialization import init_normal_, init_orthogonal_
from torchrl_tit.networks.inner import InnerTransformer, LinearFrameEncoder
from torchrl_tit.networks.mlp import MLP, MLPConfig
from torchrl_tit.networks.nature_cnn import NatureCNN, NatureCNNConfig
from torchrl_tit.networks.ofenet import OFENet, OFENetConfig
from torchrl_tit.networks.outer import PairedOuterTransformer, StackedOuterTransformer
from torchrl_tit.networks.patches import ArrayPatchEmbedding, ImagePatchEmbedding
from torchrl_tit.networks.relative_attention import RelativeSelfAttention
from torchrl_tit.networks.resnet import ResNet, ResNetConfig, ResNetFrameEncoder
from torchrl_tit.networks.tit import EnhancedTIT, VanillaTIT
from torchrl_tit.networks.tit_config import EnhancedTITConfig, TITConfig, VanillaTITConfig
from torchrl_tit.networks.two_trunks import TwoTrunkNetwork

__all__ = [
    "D2RL",
    "MLP",
    "Activation",
    "ArrayPatchEmbedding",
    "AttentionMaps",
    "Catformer",
    "CatformerConfig",
    "CatformerEncoder",
    "ClampedGaussianHead",
    "CoBERL",
    "CoBERLConfig",
    "CoBERLEncoder",
    "D2RLConfig",
    "DecisionTransformer",
    "DecisionTransformerConfig",
    "Dropout",
    "EnhancedTIT",
    "EnhancedTITConfig",
    "GPT2Block",
    "GRUGate",
    "GatedTransformerBlock",
    "GaussianHead",
    "HistoryNetwork",
    "ImagePatchEmbedding",
    "InnerTransformer",
    "LinearFrameEncoder",
    "MLPConfig",
    "NatureCNN",
    "NatureCNNConfig",
    "OFENet",
    "OFENetConfig",
    "PairedOuterTransformer",
    "RelativeSelfAttention",
    "ResNet",
    "ResNetConfig",
    "ResNetFrameEncoder",
    "SelfAttention",
    "StackedOuterTransformer",
    "TITConfig",
    "TransformerBlock",
    "TwoTrunkNetwork",
    "VanillaTIT",
    "VanillaTITConfig",
    "init_normal_",
    "init_orthogonal_",
    "make_activation",
]
