"""Exports policies to files that act without this library: `torch.export` and ONNX."""

from torchrl_tit.export.comparison import NotTheSameError
from torchrl_tit.export.policy import export_policy

__all__ = ["NotTheSameError", "export_policy"]
