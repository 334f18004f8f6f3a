"""Decision Transformer and DT_TIT of the authors' release, built from their weights."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.networks.reference import randomize
from tests.networks.reference_decision_transformer import ReferenceDT
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

KINDS = pytest.mark.parametrize("kind", ["dt", "dt_tit"])


def make_inputs(batch: int, steps: int, state: int, action: int, limit: int) -> list[Tensor]:
    """States, actions, returns, time steps and mask, with left padding in all rows but one.

    In double precision, so that what must be equal is equal on any processor.
    """
    generator = torch.Generator().manual_seed(1)
    mask = torch.ones(batch, steps, dtype=torch.int64)
    for row in range(1, batch):
        mask[row, : min(row, steps - 1)] = 0
    return [
        *(
            torch.randn(batch, steps, size, generator=generator, dtype=torch.float64)
            for size in (state, action, 1)
        ),
        torch.randint(0, limit, (batch, steps), generator=generator),
        mask,
    ]


@KINDS
@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({}, 5),
        ({"layers": 3, "heads": 4}, 20),
        ({"layers": 2, "heads": 2, "inner": 40, "activation": "gelu"}, 7),
        ({"activation": "gelu_new", "max_ep_len": 1000, "dim": 24}, 3),
        ({"activation": "tanh", "heads": 16}, 1),
    ],
)
def test_equals_the_reference(kind: str, settings: dict[str, Any], steps: int) -> None:
    reference = ReferenceDT(11, 3, tit=kind == "dt_tit", **settings)
    randomize(reference)
    config = {
        "kind": kind,
        "state_dim": 11,
        "act_dim": 3,
        "embed_dim": settings.get("dim", 16),
        "n_layer": settings.get("layers", 1),
        "n_head": settings.get("heads", 1),
        "n_inner": settings.get("inner", 64),
        "activation": settings.get("activation", "relu"),
        "context": steps,
        "max_ep_len": settings.get("max_ep_len", 50),
    }
    derived = {"state_dim", "act_dim", "embed_dim", "n_layer", "n_inner", "context", "max_ep_len"}
    short = {name: value for name, value in config.items() if name not in derived}
    prefixed = {f"model.{name}": value for name, value in reference.state_dict().items()}
    networks = from_official(config, reference.state_dict()), from_official(short, prefixed)
    inputs = make_inputs(4, steps, 11, 3, config["max_ep_len"])
    expected = reference.double()(*inputs)
    valid = inputs[-1].bool()
    assert expected[valid].std() > 0.1
    for network in networks:
        actions = network.double().eval()(*inputs)
        assert actions.isfinite().all()
        torch.testing.assert_close(actions[valid], expected[valid], rtol=0, atol=1e-9)


@KINDS
def test_a_missing_attention_bias_is_said(kind: str) -> None:
    reference = ReferenceDT(11, 3, tit=kind == "dt_tit", layers=2)
    randomize(reference)
    params = {n: p for n, p in reference.state_dict().items() if not n.endswith("attn.bias")}
    names = [f"transformer.h.{layer}.attn.c_attn.bias" for layer in range(2)]
    with pytest.warns(UserWarning, match=", ".join(names)) as warnings:
        network = from_official({"kind": kind}, params).double().eval()
    assert warnings[0].filename == __file__
    for name in names:
        torch.nn.init.zeros_(reference.get_parameter(name))
    inputs = make_inputs(1, 5, 11, 3, 50)
    expected = reference.double()(*inputs)
    torch.testing.assert_close(network(*inputs), expected, rtol=0, atol=1e-9)


@KINDS
def test_what_does_not_fit_is_named(kind: str) -> None:
    params = ReferenceDT(11, 3, tit=kind == "dt_tit").state_dict()
    for entry, name in {
        "act_dim": "head.layers.0.weight",
        "n_inner": "ffn.0.weight",
        "max_ep_len": "timestep_embedding.weight",
        "embed_dim": "embedding_norm.weight",
    }.items():
        with pytest.raises(ValueError, match=rf"{name} has shape"):
            from_official({"kind": kind, entry: 24}, params)
    with pytest.raises(ValueError, match=r"missing network\.history_encoder\.blocks\.1\."):
        from_official({"kind": kind, "n_layer": 2}, params)
    with pytest.raises(ValueError, match="field 'activation' is 'softplus', not one of"):
        from_official({"kind": kind, "activation": "softplus"}, params)
    with pytest.raises(ValueError, match="num_frames 60 is more than max_ep_len 50"):
        from_official({"kind": kind, "context": 60}, params)
    with pytest.raises(ValueError, match=r"there is no parameter"):
        from_official({"kind": kind}, {})
