"""A critic that is a plain MLP, forth and back by hand."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_tit.modules.many_actions import ManyActions


class ReLUMLP:
    """Values of a critic that is an MLP with ReLU, whose gradients are computed by hand.

    For a CPU, where a batch passes a few states at a time. Autograd makes a tensor of each
    gradient of a weight before it adds it, and of each masked gradient; here products add right
    away, and a gradient is masked where it stands. Values and gradients are those of autograd.

    Args:
        layers: of the MLP, with a ReLU after each but the last. Their weights must have gradients
            to add to.
        in_keys: what the MLP reads, beside each other.
        action_key: which of them stands for several actions in each state.
    """

    def __init__(self, layers: list[nn.Linear], in_keys: list[str], action_key: NestedKey) -> None:
        self.layers = layers
        self.in_keys = in_keys
        self.action_key = action_key

    @classmethod
    def of(cls, critic: ManyActions) -> ReLUMLP | None:
        """Finds the MLP of a critic; None where it is something else, or more than that.

        Example:
            >>> from torchrl.modules import ValueOperator
            >>> keys = ["observation", "action"]
            >>> relu = MLP(11 + 3, 1, num_cells=[8], activation_class=nn.ReLU)
            >>> ReLUMLP.of(ManyActions(ValueOperator(relu, in_keys=keys))).layers
            [Linear(in_features=14, out_features=8, bias=True), Linear(in_features=8, ...)]
            >>> tanh = MLP(11 + 3, 1, num_cells=[8], activation_class=nn.Tanh)
            >>> ReLUMLP.of(ManyActions(ValueOperator(tanh, in_keys=keys))) is None
            True
        """
        module: TensorDictModuleBase = critic.qvalue_network
        if isinstance(module, TensorDictSequential) and len(module) == 1:
            module = module[0]
        if not isinstance(module, TensorDictModule) or type(module.module) is not MLP:
            return None
        linear, relu = list(module.module)[::2], list(module.module)[1::2]
        if not all(type(m) is nn.Linear and m.bias is not None for m in linear):
            return None
        if len(linear) != len(relu) + 1 or not all(type(m) is nn.ReLU for m in relu):
            return None
        return cls(linear, list(module.in_keys), critic.action_key)

    def __call__(self, states: TensorDictBase) -> Tensor:
        """Returns values, float [B, m], that pass their gradient on to the weights.

        Args:
            states: entries [B, F] of B states, and m actions in each, [B, m, A].
        """
        shape = states.get(self.action_key).shape[:2]
        entries = [
            states.get(key) if key == self.action_key else _repeat(states.get(key), shape)
            for key in self.in_keys
        ]
        with torch.no_grad():
            inputs = [torch.cat(entries, dim=-1).flatten(0, 1)]  # of each layer, [B m, in]
            for layer in self.layers[:-1]:
                inputs.append(_linear(layer, inputs[-1]).relu_())
            values = _linear(self.layers[-1], inputs[-1]).view(shape)
        values.requires_grad_().register_hook(partial(self._backward, inputs))
        return values

    def _backward(self, inputs: list[Tensor], gradient: Tensor) -> None:
        """Adds to the weights' gradients, given that of the values, [B, m]."""
        first, *others = self.layers
        x, *hidden = inputs
        with torch.no_grad():
            gradient = gradient.reshape(-1, 1)  # [B m, out]
            for layer, active in zip(reversed(others), reversed(hidden), strict=True):
                _gradient(layer.weight).addmm_(gradient.mT, active)
                _gradient(layer.bias).add_(gradient.sum(dim=0))
                gradient = gradient @ layer.weight
                # It passes a ReLU where what that put out is positive.
                torch.ops.aten.threshold_backward.grad_input(
                    gradient, active, 0, grad_input=gradient
                )
            # The other way round: where states and actions are few, a product with few rows is
            # faster than one with few columns.
            _gradient(first.weight).add_((x.mT @ gradient).mT)
            _gradient(first.bias).add_(gradient.sum(dim=0))


def _repeat(x: Tensor, shape: torch.Size) -> Tensor:
    """[B, F] -> [B, m, F]."""
    return x.unsqueeze(1).expand(*shape, -1)


def _gradient(weight: Tensor) -> Tensor:
    assert weight.grad is not None
    return weight.grad


def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
    return torch.addmm(layer.bias, x, layer.weight.mT)
