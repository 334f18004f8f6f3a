"""A Q network that evaluates several actions in each state."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential


class ManyActions(TensorDictModuleBase):
    """Makes a Q network evaluate several actions in each state.

    In a sequence of modules, those before the first one that reads the action (a backbone, for
    example) run once per state, and their outputs are expanded over the actions. TorchRL's losses
    repeat the state instead, and run the whole network once per action.

    Args:
        qvalue_network: reads entries of the state [*batch, ...] and an action [*batch, A], and
            writes a value [*batch, 1].
        action_key: key of the action.

    Raises:
        ValueError: if the network does not read the action.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, ValueOperator
        >>> q = ManyActions(ValueOperator(MLP(11 + 3, 1), in_keys=["observation", "action"]))
        >>> states, actions = torch.randn(8, 11), torch.rand(8, 30, 3)
        >>> td = q(TensorDict({"observation": states, "action": actions}, [8]))
        >>> td["state_action_value"].shape
        torch.Size([8, 30, 1])
    """

    def __init__(
        self, qvalue_network: TensorDictModuleBase, action_key: NestedKey = "action"
    ) -> None:
        super().__init__()
        if action_key not in qvalue_network.in_keys:
            raise ValueError(
                f"a Q network must read the action under {action_key!r}, but this one reads "
                f"{list(qvalue_network.in_keys)}"
            )
        self.qvalue_network = qvalue_network
        self.action_key = action_key
        self.in_keys = list(qvalue_network.in_keys)
        self.out_keys = list(qvalue_network.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the values: [*batch, A] -> [*batch, 1], or [*batch, m, A] -> [*batch, m, 1]."""
        action = tensordict.get(self.action_key)
        network = self.qvalue_network
        if action.ndim == tensordict.ndim + 1:
            return network(tensordict)
        modules = list(network.module) if isinstance(network, TensorDictSequential) else [network]
        states = tensordict.exclude(self.action_key)
        first = next(i for i, m in enumerate(modules) if self.action_key in m.in_keys)
        for module in modules[:first]:
            states = module(states)
        later = [key for module in modules[first:] for key in module.in_keys]
        states = states.select(*later, strict=False)  # expanding copies, and histories are large
        shape = (*tensordict.shape, action.shape[-2])
        # One batch dimension: for several, linear layers return views of flat products, and
        # autograd copies a view that is modified in place, for example by an in-place ReLU.
        each = states.unsqueeze(-1).expand(shape).reshape(-1)
        each.set(self.action_key, action.flatten(0, -2))
        for module in modules[first:]:
            each = module(each)
        for key in (key for module in modules[first:] for key in module.out_keys):
            tensordict.set(key, each.get(key).unflatten(0, shape))
        return tensordict
