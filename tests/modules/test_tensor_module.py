"""Heads write tensors without a search for data frames."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from recipes.algorithm import make_algorithm
from recipes.registry import get_recipe
from torchrl_tit.modules.tensor_module import TensorModule


@pytest.mark.parametrize(
    "name", ["ppo/cartpole/enhanced-tit", "ppo/hopper/mlp", "sac/hopper/mlp", "dqn/cartpole/mlp"]
)
def test_policies_write_without_a_search(name, monkeypatch):
    algorithm = make_algorithm(get_recipe(name))
    td = algorithm.make_env(2, 0).reset()

    def search(*args: object, **kwargs: object) -> None:
        raise AssertionError("TensorDict looks for data frames")

    monkeypatch.setattr(TensorDict, "from_any", search)
    assert algorithm.policy(td)["action"].shape[0] == 2


@pytest.mark.parametrize("out_keys", [["y"], ["y", "z"], ["_", "z"], [("deep", "y"), "z"]])
def test_writes_what_tensordict_writes(out_keys):
    def network(x: torch.Tensor):
        return x + 1 if len(out_keys) == 1 else (x + 1, x * 2)

    td = TensorDict(x=torch.arange(3.0), batch_size=[3])
    written = [
        module(network, in_keys=["x"], out_keys=out_keys)(td.clone())
        for module in (TensorModule, TensorDictModule)
    ]
    assert set(written[0].keys(True)) == set(written[1].keys(True))
    assert (written[0] == written[1]).all()


def test_what_is_no_tensor_is_left_to_tensordict():
    module = TensorModule(lambda x: {"a": x}, in_keys=["x"], out_keys=["y"])
    td = module(TensorDict(x=torch.arange(3.0), batch_size=[3]))
    assert td["y", "a"].tolist() == [0, 1, 2]
    wrong = TensorModule(nn.Identity(), in_keys=["x"], out_keys=["y", "z"])
    with pytest.raises(RuntimeError, match="out_keys"):
        wrong(td)


def test_out_of_place():
    module = TensorModule(nn.Identity(), in_keys=["x"], out_keys=["y"], inplace=False)
    td = TensorDict(x=torch.arange(3.0), batch_size=[3])
    assert set(module(td).keys()) == {"y"}
    other = TensorDict(batch_size=[3])
    TensorModule(nn.Identity(), in_keys=["x"], out_keys=["y"])(td, tensordict_out=other)
    assert set(other.keys()) == {"y"}
    assert "y" not in td
