"""The two initializations of the paper's experiments."""

from __future__ import annotations

from torch import nn

from torchrl_tit.layers.patches import ImagePatchEmbedding


def init_normal_(module: nn.Module, std: float = 0.02) -> None:
    """Initializes like the authors' networks: linear and embedding weights normal, biases 0.

    LayerNorms become 1 and 0. Convolutions, patch embeddings and the input projections of
    attention keep PyTorch's defaults, except those of Transformer-XL's attention (GTrXL, CoBERL),
    which are linear layers; class tokens and position encodings are initialized by their modules.
    (The authors use a truncated normal, whose absolute bounds do not matter at 0.02.)

    Args:
        module: the network, changed in place.
        std: standard deviation of the weights.

    Example:
        >>> network = nn.Linear(64, 64)
        >>> init_normal_(network)
        >>> bool(network.bias.abs().max() == 0)
        True
    """
    for child in module.modules():
        if isinstance(child, nn.Linear | nn.Embedding):
            nn.init.normal_(child.weight, std=std)
        if isinstance(child, nn.Linear) and child.bias is not None:
            nn.init.zeros_(child.bias)
        if isinstance(child, nn.LayerNorm):
            child.reset_parameters()


def init_orthogonal_(module: nn.Module, gain: float = 2**0.5) -> None:
    """Initializes like Stable-Baselines3, which trained the paper's online networks.

    The weights of every linear layer (including output projections of attention) and 2-d
    convolution (including image patch embeddings) become orthogonal, their biases 0. The array
    patch embedding, a 1-d convolution there, and the input projections of attention are left
    unchanged, except those of Transformer-XL's attention (GTrXL, CoBERL), which are linear layers.

    Args:
        module: the network, changed in place.
        gain: sqrt(2) for feature extractors, 0.01 for action heads, 1 for value heads.

    Example:
        >>> head = nn.Linear(64, 2)
        >>> init_orthogonal_(head, gain=0.01)
        >>> round(head.weight[0].norm().item(), 4)
        0.01
    """
    for child in module.modules():
        if isinstance(child, nn.Linear | nn.Conv2d | ImagePatchEmbedding):
            nn.init.orthogonal_(child.weight, gain=gain)
            bias = getattr(child, "bias", None)
            if bias is not None:
                nn.init.zeros_(bias)
