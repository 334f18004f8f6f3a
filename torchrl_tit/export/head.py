"""The layers between a policy's features and its action, on plain tensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
    set_interaction_type,
)
from tensordict.nn.probabilistic import InteractionType
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.modules import QValueModule

from torchrl_tit.modules import Backbone
from torchrl_tit.modules.distributions import IndependentBernoulli


class Head(nn.Module):
    """The modules of a policy that map features to an action, and no others.

    By default, it takes the most likely action. A sample is the most likely action after noise was
    added to the parameters of the distribution: a Gumbel variable to logits (a logistic one for
    binary actions), or a standard normal one times the standard deviation to a mean. So a sampling
    policy is also a pure function, which gives the same samples in every runtime, and acts
    deterministically with zero noise. (Maddison et al., "A* Sampling", arXiv 1411.0030, section 2,
    describe the first; the others are inverse distribution functions.)

    Args:
        modules: all modules of a policy after its backbone, in order.
        action_key: key of the action.

    Raises:
        ValueError: if none of them writes the action.
    """

    def __init__(
        self, modules: Sequence[TensorDictModuleBase], action_key: NestedKey = "action"
    ) -> None:
        super().__init__()
        self.action_key = unravel_key(action_key)
        needed = {self.action_key}
        used: list[TensorDictModuleBase] = []
        for module in reversed(modules):  # a critic, for example, is left out
            writes = {unravel_key(key) for key in module.out_keys}
            if writes & needed:
                used.insert(0, module)
                needed = (needed - writes) | {unravel_key(key) for key in module.in_keys}
        if not used:
            raise ValueError(f"the policy writes no {action_key!r} behind its backbone")
        self.reads: set[NestedKey] = needed
        """Keys that the modules read: features, masks."""
        *layers, last = used
        chooses = isinstance(last, ProbabilisticTensorDictModule | QValueModule)
        self.layers = nn.ModuleList(layers if chooses else used)
        self.choice = last if chooses else None
        """The module that maps a distribution's parameters, or the values of actions, to an
        action."""

    @property
    def noise(self) -> str | None:
        """The kind of noise, by the name of NumPy's generator; None if actions are not sampled."""
        if not isinstance(self.choice, ProbabilisticTensorDictModule):
            return None
        if self.choice.distribution_class is IndependentBernoulli:
            return "logistic"
        return "gumbel" if "logits" in self.choice.in_keys else "standard_normal"

    @property
    def parameter_keys(self) -> list[str]:
        """Keys on which the choice depends: "logits", "loc" and "scale", or "action_value"."""
        if self.choice is None:
            return []
        known = ("logits", "loc", "scale", "action_value")
        return [key for key in known if key in self.choice.in_keys]

    def forward(
        self, entries: Mapping[NestedKey, Tensor], noise: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Maps features to actions.

        Args:
            entries: the entries that ``reads`` lists, [N, ...] each.
            noise: noise with the shape of the logits or the mean; None for the most likely action.

        Returns:
            The action [N, ...], and the entries that ``parameter_keys`` lists.
        """
        tensordict: TensorDictBase = TensorDict(dict(entries))
        for layer in self.layers:
            tensordict = layer(tensordict)
        parameters = {key: tensordict.get(key) for key in self.parameter_keys}
        return self.choose(tensordict, noise), parameters

    def choose(self, tensordict: TensorDictBase, noise: Tensor | None = None) -> Tensor:
        """Chooses an action, given the parameters of the distribution and, if any, the mask."""
        if self.choice is not None:
            if noise is not None:
                key = "logits" if "logits" in tensordict.keys() else "loc"  # noqa: SIM118
                scale = 1 if key == "logits" else tensordict["scale"]
                tensordict = tensordict.copy()
                tensordict.set(key, tensordict.get(key) + scale * noise)
            with set_interaction_type(InteractionType.DETERMINISTIC):
                tensordict = self.choice(tensordict)
        return tensordict.get(self.action_key)


def split_policy(policy: nn.Module) -> tuple[Backbone, list[TensorDictModuleBase]]:
    """Splits a policy into its backbone and the modules after it.

    Args:
        policy: a sequence of TensorDict modules, nested or not.

    Raises:
        ValueError: if it does not begin with a backbone.
    """
    backbone, *modules = _leaves(policy)
    if not isinstance(backbone, Backbone):
        raise ValueError(
            f"the policy begins with {type(backbone).__name__}, but only one that begins with a "
            "torchrl_tit Backbone, as TensorDictSequential(backbone, actor) does, can be exported"
        )
    return backbone, modules


def _leaves(module: nn.Module) -> Iterator[TensorDictModuleBase]:
    if isinstance(module, TensorDictSequential):
        for part in module.module:
            yield from _leaves(part)
    else:
        assert isinstance(module, TensorDictModuleBase)
        yield module
