"""The layers of Grad-CAM, whose outputs still have the layout of an image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.checks import nearest


@dataclass(frozen=True)
class ImageLayer:
    """A layer whose output has the layout of an image."""

    name: str
    """Its name in the network."""
    module: nn.Module
    """The layer."""
    grid: tuple[int, int] | None
    """Rows and columns of the patches, if it outputs tokens; None for convolutions."""

    def lay_out(self, output: Tensor) -> Tensor:
        """Arranges a layer's output like the image: patches row by row, without the class token.

        Args:
            output: float [M, C, h, w], or tokens [M, S, D].

        Returns:
            float [M, C or D, h, w].

        Raises:
            ValueError: if the number of positions does not match the patches.
        """
        if output.ndim == 4:
            return output
        if self.grid is not None and output.ndim == 3:
            rows, columns = self.grid
            patches = rows * columns
            if output.shape[1] in (patches, patches + 1):
                tokens = output[:, -patches:]
                return tokens.transpose(1, 2).unflatten(2, (rows, columns))
        found = list(output.shape)
        raise ValueError(
            f"the output of the layer {self.name!r} has the shape {found}, which is no image "
            "[N, C, h, w] and no row of patches: choose a convolution, or the input "
            "normalization of a block (norm1)"
        )


def image_layers(network: HistoryNetwork) -> dict[str, ImageLayer]:
    """Finds the layer of Grad-CAM for each image that a network reads.

    For transformers, it is the input normalization of the last inner block: after it, the last
    block computes only the class token, so patches get no gradient. For convolutional networks, it
    is the last convolution.

    Returns:
        The layers by the name of the observation; images without such a layer are left out.
    """
    layers = {}
    names = {module: name for name, module in network.named_modules()}
    for (name, observation), encoder in zip(
        network.observations.items(), network.frames, strict=True
    ):
        if observation.kind != "image":
            continue
        layer = _find(encoder) or _find(network.history_encoder)
        if layer is not None:
            module, grid = layer
            layers[name] = ImageLayer(names[module], module, grid)
    return layers


def named_layer(network: HistoryNetwork, layer: str) -> tuple[str, ImageLayer]:
    """Finds a layer by its name.

    Returns:
        The name of the observation that it belongs to, and the layer.

    Raises:
        ValueError: if there is no such layer, or it belongs to no image; the message names similar
            ones.
    """
    modules = dict(network.named_modules())
    if layer not in modules or not layer:
        usual = " or ".join(found.name for found in image_layers(network).values())
        hint = f"; {usual} is the usual one" if usual else ""
        known = [name for name in modules if name]
        raise ValueError(
            f"there is no layer {layer!r} in this network{hint}: {nearest(layer, known)}"
        )
    images = [name for name, seen in network.observations.items() if seen.kind == "image"]
    owners = dict(zip(network.observations, network.frame_encoders, strict=True))
    inside = [name for name in images if layer.startswith(f"frame_encoders.{owners[name]}.")]
    if not inside and layer.startswith("history_encoder.") and len(owners) == 1:
        inside = images
    if not inside:
        raise ValueError(f"the layer {layer!r} reads no image: choose one of a frame encoder of it")
    inner = [
        module
        for name, module in modules.items()
        if isinstance(module, InnerTransformer) and layer.startswith(f"{name}.")
    ]
    grid = getattr(inner[-1].patch_embedding, "grid", None) if inner else None
    return inside[0], ImageLayer(layer, modules[layer], grid)


def patch_grid(network: HistoryNetwork, observation: str) -> tuple[int, int]:
    """Returns rows and columns of the patches: one row of an array's, one column of a set's.

    Raises:
        ValueError: if no inner transformer reads it.
    """
    index = list(network.observations).index(observation)
    for part in (network.frames[index], network.history_encoder):
        inner = inner_of(part)
        if inner is not None:
            patches = inner.patch_embedding
            if network.frames[index].reads_entities:
                return patches.num_patches, 1
            return getattr(patches, "grid", None) or (1, patches.num_patches)
    raise ValueError(
        f"no inner transformer reads {observation!r}, so there are no patches: this network has no "
        "attention over them"
    )


def _find(part: nn.Module) -> tuple[nn.Module, tuple[int, int] | None] | None:
    """The layer in a part of the network, and the grid of its patches."""
    inner = inner_of(part)
    if inner is not None:
        last = inner.blocks[(inner.num_blocks - 1) % len(inner.blocks)]
        grid = getattr(inner.patch_embedding, "grid", None)
        return (last.get_submodule("norm1"), grid) if grid is not None else None
    convolutions = [module for module in part.modules() if isinstance(module, nn.Conv2d)]
    return (convolutions[-1], None) if convolutions else None


def inner_of(part: nn.Module) -> InnerTransformer | None:
    """Returns the inner transformer in a part of a network, if there is one."""
    return next((m for m in part.modules() if isinstance(m, InnerTransformer)), None)
