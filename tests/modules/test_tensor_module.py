"""Heads write tensors without a search for data frames."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, MultiCategorical

from torchrl_tit import Backbone
from torchrl_tit.modules import make_actor, make_squashed_actor, make_value
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.networks import build_network
from torchrl_tit.settings import NETWORKS


@pytest.mark.parametrize("trunks", ["shared", "separate"])
def test_policies_write_without_a_search(trunks, monkeypatch):
    keys = ["policy", "value"] if trunks == "separate" else ["policy"]
    backbone = Backbone(build_network(NETWORKS["mlp"](2), (4,), trunks=trunks), out_keys=keys)
    heads = [
        make_actor(64, MultiCategorical([2, 3]), in_key="policy"),
        make_squashed_actor(64, Bounded(-1, 1, (3,)), in_key="policy", action_key="squashed"),
        make_value(64, in_key=keys[-1]),
    ]

    def search(*args: object, **kwargs: object) -> None:
        raise AssertionError("TensorDict looks for data frames")

    monkeypatch.setattr(TensorDict, "from_any", search)
    td = TensorDictSequential(backbone, *heads)(TensorDict({"history": torch.randn(5, 2, 4)}, [5]))
    assert td["squashed"].shape == (5, 3)


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
