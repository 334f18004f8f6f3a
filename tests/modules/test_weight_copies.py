"""Copies of weights detect every change of their values, and nothing else."""

import pytest
import torch
from torch import nn

from torchrl_tit.modules.weight_copies import WeightCopies, modules_within, weights_within


def make(dtype=torch.float32):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 3), nn.Sequential(nn.LayerNorm(3)), nn.Linear(3, 2))
    network.register_buffer("counts", torch.arange(4))
    network.register_buffer("flag", torch.tensor(True))
    network.register_buffer("nothing", None)
    return network.to(dtype)


def test_all_modules_and_weights_are_found():
    network = make()
    modules = modules_within(network)
    assert modules == list(network.modules())
    expected = [*network.parameters(), *network.buffers()]
    assert {id(weight) for weight in weights_within(modules)} == {id(x) for x in expected}
    # What losses do: a plain tensor in the place of a parameter.
    network[0]._parameters.pop("weight")
    network[0].weight = torch.zeros(3, 3)
    assert any(weight is network[0].weight for weight in weights_within(modules))


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16], ids=str
)
def test_the_least_change_of_any_weight_is_noticed(dtype):
    network = make(dtype)
    modules = modules_within(network)
    for weight in weights_within(modules):
        copies = WeightCopies(modules)
        assert copies.match(modules)
        weight.detach().view(-1)[-1:].view(torch.uint8)[0] ^= 1  # the last bit
        assert not copies.match(modules)
        assert WeightCopies(modules).match(modules)


def test_equal_weights_elsewhere_in_memory_match():
    network = make()
    modules = modules_within(network)
    copies = WeightCopies(modules)
    network.load_state_dict({k: v.clone() for k, v in network.state_dict().items()}, assign=True)
    network[0].weight.data = network[0].weight.data.t().contiguous().t()
    network.share_memory()
    assert copies.match(modules)


def test_not_a_number_equals_itself():
    network = make()
    modules = modules_within(network)
    network[0].weight.data[0, 0] = float("nan")
    copies = WeightCopies(modules)
    assert copies.match(modules)
    network[0].weight.data[0, 0] = -0.0
    assert not copies.match(modules)


def test_the_same_bytes_in_another_order_shape_or_type_are_others():
    network = make()
    modules = modules_within(network)
    weight = network[0].weight
    copies = WeightCopies(modules)
    weight.data = weight.data.t()  # the same memory
    assert not copies.match(modules)
    weight.data = weight.data.t()
    assert copies.match(modules)
    weight.data = weight.data.view(1, 9)
    assert not copies.match(modules)
    weight.data = weight.data.view(3, 3)
    network.counts = network.counts.view(torch.float64)
    assert not copies.match(modules)


def test_other_modules_are_others():
    network = make()
    copies = WeightCopies(modules_within(network))
    assert not copies.match(modules_within(make()))
    assert not copies.match(modules_within(network[0]))
    network[0].bias = None
    assert not copies.match(modules_within(network))
