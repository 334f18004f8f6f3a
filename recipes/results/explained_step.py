"""What a policy looked at in one step, and what it chose: the data of explanations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, distributions

from torchrl_tit.analysis import (
    Target,
    grad_cam,
    integrated_gradients,
    map_attention,
    outer_attention,
)
from torchrl_tit.analysis.layers import image_layers
from torchrl_tit.analysis.targets import evaluating, find_network, histories_of, run_policy

MapKind = Literal["grad-cam", "integrated-gradients", "attention"]


@dataclass(frozen=True)
class Choice:
    """An action, and what it was chosen from."""

    title: str
    """The meaning of the heights."""
    labels: list[str]
    heights: np.ndarray
    """Probabilities or values of the options, or the entries of a continuous action, [n]."""
    spreads: np.ndarray | None
    """The standard deviations of these entries, if the policy samples them, [n]."""
    chosen: list[bool]
    """Which were chosen; all entries of a continuous action."""


@dataclass(frozen=True)
class Seen:
    """An observation of the K steps, and how much each part of it matters."""

    frames: np.ndarray
    """The K observations, the oldest first: images [K, H, W] or [K, C, H, W], or arrays [K, D]."""
    maps: np.ndarray
    """What matters in them: of images [K, h, w], or [1, h, w] of all together; of arrays [K, D]."""

    @property
    def is_image(self) -> bool:
        """Whether it is an image."""
        return self.frames.ndim > 2


@dataclass(frozen=True)
class ExplainedStep:
    """What a policy looked at in one step, and what it chose."""

    seen: dict[str, Seen]
    """By the name of the observation; observations without a map are left out."""
    attention: np.ndarray | None
    """Attention of the newest step to each step, [blocks, heads, K], if there is attention."""
    choice: Choice
    value: float | None
    """The value of the state, or of the action, if the policy computes one."""


class Explainer:
    """Explains steps of a policy.

    Args:
        policy: the policy.
        target: what is explained; see :data:`~torchrl_tit.analysis.targets.Target`.
        kind: kind of maps: Grad-CAM of images, integrated gradients, or attention rolled out over
            the inner blocks. By default Grad-CAM of images that a convolution or an inner
            transformer reads, and integrated gradients of everything else but categories.
        layer: name of another layer for Grad-CAM.

    Raises:
        ValueError: if the policy has no network of this library, or there is no such kind.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        target: Target = "action",
        kind: MapKind | None = None,
        layer: str | None = None,
    ) -> None:
        if kind is not None and kind not in get_args(MapKind):
            raise ValueError(f"maps are one of {', '.join(get_args(MapKind))}, not {kind!r}")
        if layer is not None and kind not in (None, "grad-cam"):
            raise ValueError(f"a layer is for grad-cam, not for {kind}: leave one of them out")
        self.policy = policy
        self.target = target
        self.layer = layer
        self.network = find_network(policy, target)
        if kind is None and layer is not None:
            kind = "grad-cam"
        self.kind = kind

    def explain(self, tensordict: TensorDictBase) -> ExplainedStep:
        """Explains a step.

        Args:
            tensordict: tensordict of one environment, [1], after the policy has acted.

        Raises:
            ValueError: if there are no such maps for this network, or its policy does not compute
                the target.
        """
        state = tensordict.detach()
        with evaluating(self.policy), torch.no_grad():
            outputs, distribution = run_policy(self.policy, state)
        histories = histories_of(self.policy, state)
        seen = {}
        frames = dict(zip(self.network.observations, histories, strict=False))
        for name, maps in self._maps(state, histories).items():
            seen[name] = Seen(_array(frames[name][0]), _array(maps[0]))
        try:
            attention = _array(outer_attention(self.network, *histories)[0])
        except ValueError:  # there is none
            attention = None
        return ExplainedStep(
            seen, attention, describe_choice(outputs, distribution), read_value(outputs)
        )

    def _maps(self, state: TensorDictBase, histories: Sequence[Tensor]) -> dict[str, Tensor]:
        """The maps by the name of the observation, [1, K or 1, ...] each."""
        if self.kind == "attention":
            kinds = {name: seen.kind for name, seen in self.network.observations.items()}
            maps = map_attention(self.network, *histories)
            return {k: x if kinds[k] == "image" else x.flatten(-2) for k, x in maps.items()}
        if self.kind == "grad-cam":
            return grad_cam(self.policy, state, target=self.target, layer=self.layer)
        rest = {n for n, seen in self.network.observations.items() if seen.kind != "categories"}
        found: dict[str, Tensor] = {}
        if self.kind is None and (images := image_layers(self.network)):
            found = grad_cam(self.policy, state, target=self.target)
            rest -= set(images)
        if rest:
            shares = integrated_gradients(self.policy, state, target=self.target)
            for name in rest:
                observation = self.network.observations[name]
                share = shares[name]
                if observation.kind == "image":  # channels of a pixel count together
                    share = share.abs().flatten(2, -3).sum(2) if share.ndim > 4 else share.abs()
                found[name] = share
        return {name: found[name] for name in self.network.observations if name in found}


def describe_choice(
    outputs: TensorDictBase, distribution: distributions.Distribution | None
) -> Choice:
    """Describes an action and what it was chosen from.

    Args:
        outputs: what the policy wrote, [1].
        distribution: distribution of its actions, if there is one.
    """
    action = outputs["action"][0]
    base: Any = getattr(distribution, "base_dist", distribution)
    if action.is_floating_point():
        entries = action.flatten()
        scale = getattr(base, "scale", None) if isinstance(base, distributions.Normal) else None
        return Choice(
            "action" if scale is None else "action, and its spread",
            [str(i) for i in range(len(entries))],
            _array(entries),
            None if scale is None else _array(scale[0].flatten()),
            [True] * len(entries),
        )
    if distribution is None:
        values = outputs["action_value"][0]
        chosen = [i == int(action) for i in range(len(values))]
        return Choice("values of actions", _numbers(values), _array(values), None, chosen)
    probabilities = base.probs[0]
    if isinstance(base, distributions.Bernoulli):
        on = action.flatten().bool().tolist()
        flat = probabilities.flatten()
        return Choice("probabilities of on", _numbers(flat), _array(flat), None, on)
    if probabilities.ndim == 1:
        index = int(action.int().argmax()) if action.ndim else int(action)
        chosen = [i == index for i in range(len(probabilities))]
        return Choice(
            "action probabilities", _numbers(probabilities), _array(probabilities), None, chosen
        )
    components = probabilities.flatten(0, -2)
    likely = components.argmax(-1)
    # A component with fewer options than another is padded with probabilities of 0.
    pairs = [(c, o) for c, row in enumerate(components) for o in range(_options(row))]
    return Choice(
        "action probabilities",
        [f"{c}: {o}" for c, o in pairs],
        np.array([float(components[c, o]) for c, o in pairs]),
        None,
        [int(likely[c]) == o for c, o in pairs],
    )


def _options(probabilities: Tensor) -> int:
    """The number of options up to the last possible one."""
    return int(probabilities.nonzero().max()) + 1


def read_value(outputs: TensorDictBase) -> float | None:
    """Returns the value that a policy wrote, if it computes any: the state's, or the action's."""
    for key in ("state_value", "chosen_action_value"):
        value = outputs.get(key, None)
        if value is not None:
            return float(value.flatten()[0])
    return None


def _numbers(values: Tensor) -> list[str]:
    return [str(i) for i in range(len(values))]


def _array(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()
