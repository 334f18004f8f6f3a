"""TorchRL transforms that hand a network the last K observations."""

from torchrl_tit.transforms.history import History

__all__ = ["History"]
