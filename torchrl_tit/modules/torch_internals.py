"""What PyTorch knows and has no public name for, all in one place.

:class:`~torchrl_tit.modules.FrameCache` decides with Python whether kept tokens can be used, and
checks of values end in Python errors. Neither is possible while PyTorch records or transforms the
computation; a public ``torch.func.is_transforming()`` would make :func:`is_transformed`
unnecessary. No public list of a module's weights is cheap enough to be read at each step
(``module.parameters()`` takes 0.16 ms for a small encoder, 6% of a step of 8 CartPoles), and no
public count tells how often a tensor was written.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

_BATCH_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)
_DROPOUTS = (
    *(nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Dropout3d),
    *(nn.AlphaDropout, nn.FeatureAlphaDropout),
)


def is_transformed() -> bool:
    """Returns whether values cannot decide what Python does next.

    That is within ``torch.compile`` and ``torch.export``, and under ``vmap`` and the other
    transforms of ``torch.func``.

    Example:
        >>> is_transformed()
        False
        >>> _ = torch.vmap(lambda x: print(is_transformed()) or x)(torch.zeros(2))
        True
    """
    return torch.compiler.is_compiling() or torch._C._functorch.peek_interpreter_stack() is not None


def is_mapped(tensor: Tensor) -> bool:
    """Returns whether ``vmap`` or another transform of ``torch.func`` maps over a tensor.

    One over weights alone, such as TorchRL's over several critics, leaves the data as they are.

    Example:
        >>> data = torch.ones(2)
        >>> _ = torch.vmap(lambda x: print(is_mapped(x), is_mapped(data)) or x)(data)
        True False
    """
    compiling = torch.compiler.is_compiling()
    return not compiling and torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def is_recorded(tensor: Tensor) -> bool:
    """Returns whether the values of a tensor are missing, or stand for others.

    In addition to :func:`is_transformed`, that is within ``torch.jit.trace``, forward-mode
    derivatives and CUDA graphs, and for fake tensors and those on the "meta" device.
    """
    return (
        is_transformed()
        or torch.jit.is_tracing()
        or type(tensor) is not Tensor  # a fake tensor
        or tensor.is_meta
        or forward_ad.unpack_dual(tensor).tangent is not None
        or (tensor.is_cuda and torch.cuda.is_current_stream_capturing())
    )


class Weights:
    """The parameters and buffers of a module, watched for changes.

    Args:
        module: the module.

    Example:
        >>> layer = nn.Linear(2, 2)
        >>> weights = Weights(layer)
        >>> before = weights.state()
        >>> layer.load_state_dict(layer.state_dict())
        <All keys matched successfully>
        >>> weights.state() == before
        False
    """

    def __init__(self, module: nn.Module) -> None:
        self._tensors = [
            x for part in module.modules() for x in (part._parameters, part._buffers) if x
        ]
        self._count = len(self.present())

    def present(self) -> list[Tensor]:
        """Returns the weights, without those that ``to_module`` has replaced by plain tensors."""
        return [x for tensors in self._tensors for x in tensors.values() if x is not None]

    def state(self) -> tuple[int, ...] | None:
        """Identifies each weight and how often it was written; None if writes leave no trace."""
        present = self.present()
        if len(present) != self._count:
            return None
        try:
            return tuple([n for x in present for n in (id(x), x._version)])
        except RuntimeError:  # not counted, for tensors of inference mode
            return None


def mode_dependent(module: nn.Module) -> list[nn.Module]:
    """Returns the parts of a module that compute something else in training mode."""
    return [part for part in module.modules() if _depends_on_mode(part)]


def _depends_on_mode(part: nn.Module) -> bool:
    if isinstance(part, _DROPOUTS):
        return part.p > 0
    if isinstance(part, nn.MultiheadAttention | nn.RNNBase):  # without a module for their dropout
        return part.dropout > 0
    return isinstance(part, _BATCH_NORMS)
