"""Grad-CAM: the places in an image that raise a target."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_tit.analysis.layers import ImageLayer, image_layers, named_layer
from torchrl_tit.analysis.targets import (
    Target,
    as_batch,
    check_gradient,
    compute_target,
    find_network,
)
from torchrl_tit.networks.building import evaluating


def grad_cam(
    policy: TensorDictModuleBase,
    tensordict: TensorDictBase,
    *,
    target: Target = "action",
    layer: str | None = None,
    relu: bool = True,
) -> dict[str, Tensor]:
    r"""Maps the places in images that raise a target, with Grad-CAM.

    .. math:: \mathrm{map} = \mathrm{relu}\Big(\sum_c w_c A_c\Big), \quad
        w_c = \frac{1}{hw} \sum_{ij} \frac{\partial\, \mathrm{target}}{\partial A_{cij}}

    for the output A of a layer with c channels on h x w places. For inner transformers, places are
    patches, channels are the entries of their tokens, and the layer is the input normalization of
    the last block: after it, the last block computes only the class token, so patches get no
    gradient. The class token is left out. For convolutional networks, the layer is the last
    convolution.

    Selvaraju et al., "Grad-CAM: Visual Explanations from Deep Networks via Gradient-based
    Localization", arXiv 1610.02391; the pictures of arXiv 2212.14538, appendix "Feature Attention
    Visualization".

    Args:
        policy: a policy with a :class:`~torchrl_tit.modules.Backbone`; dropout is off.
        tensordict: the policy's inputs, [N] or []; its "action", if present, is the chosen one.
        target: the explained quantity; see :data:`~torchrl_tit.analysis.targets.Target`.
        layer: name of another layer in the network (with two trunks, in the target's); then only
            its image is mapped.
        relu: whether to leave out places that lower the target.

    Returns:
        A map of each image by the name of the observation, float [N, K, h, w]; for networks that
        stack the frames as channels, [N, 1, h, w]: one map for all frames.

    Raises:
        ValueError: if the network reads no image with such a layer, there is no layer of that name,
            its output is not laid out over the image or the target does not depend on it, or the
            policy does not compute the target.

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> from torchrl_tit.modules import make_actor
        >>> tit = EnhancedTIT((84, 84), num_frames=4, patch_size=12)
        >>> policy = TensorDictSequential(Backbone(tit), make_actor(64, Categorical(6)))
        >>> state = TensorDict({"history": torch.rand(2, 4, 84, 84)}, [2])
        >>> grad_cam(policy, state)["observation"].shape
        torch.Size([2, 4, 7, 7])
    """
    network = find_network(policy, target)
    layers: Mapping[str, ImageLayer]
    if layer is None:
        layers = image_layers(network)
        if not layers:
            raise ValueError(
                "this network has no convolution and no inner transformer that reads an image, so "
                "there is nothing for Grad-CAM to map: use integrated gradients"
            )
    else:
        name, found = named_layer(network, layer)
        layers = {name: found}
    state = as_batch(tensordict)
    with evaluating(policy), torch.enable_grad(), ExitStack() as hooks:
        recorders = {name: _Recorder(found.module, hooks) for name, found in layers.items()}
        value = compute_target(policy, state, target)
        total = value.sum()  # the states of a batch do not depend on each other
    outputs = [recorder.output(layers[name]) for name, recorder in recorders.items()]
    check_gradient(value, target)
    slopes = torch.autograd.grad(total, outputs, allow_unused=True)
    maps = {}
    for (name, found), output, slope in zip(layers.items(), outputs, slopes, strict=True):
        if slope is None:
            raise ValueError(
                f"the target does not depend on the output of the layer {found.name!r}: choose a "
                "layer before the last block's attention"
            )
        activation, slope = found.lay_out(output.detach()), found.lay_out(slope)
        weights = slope.mean((2, 3), keepdim=True)  # [M, C, 1, 1]
        seen = (weights * activation).sum(1)  # [M, h, w]
        seen = seen.unflatten(0, (len(state), -1))
        maps[name] = seen.relu() if relu else seen
    return maps


class _Recorder:
    """Keeps the output of a layer's last call, detached from its inputs.

    Only the last call counts, because blocks can share their weights.
    """

    def __init__(self, module: nn.Module, hooks: ExitStack) -> None:
        self._output: Any = None
        hooks.callback(module.register_forward_hook(self._record).remove)

    def _record(self, module: nn.Module, inputs: Any, output: Any) -> Any:
        self._output = output
        if isinstance(output, Tensor):
            self._output = output.detach().requires_grad_()
        return self._output

    def output(self, layer: ImageLayer) -> Tensor:
        """The output, float [M, C, h, w] or [M, S, D]."""
        if not isinstance(self._output, Tensor):
            found = "is not called" if self._output is None else "puts out no tensor"
            raise ValueError(
                f"the layer {layer.name!r} {found} when the policy acts: choose another"
            )
        return self._output
