"""Decision Transformer and DT_TIT of the authors' release, built from their weights."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import ReferenceBlock, randomize
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

KINDS = pytest.mark.parametrize("kind", ["dt", "dt_tit"])


class ReferenceDT(nn.Module):
    """The authors' embeddings and heads around the library's GPT-2, every token computed.

    Takes states [B, K, S], actions [B, K, A], returns, time steps, mask.
    """

    def __init__(
        self,
        state_dim: int,
        act_dim: int,
        *,
        tit: bool,
        dim: int = 16,
        layers: int = 1,
        heads: int = 1,
        inner: int = 64,
        activation: str = "relu",
        max_ep_len: int = 50,
    ) -> None:
        super().__init__()
        self.tit = tit
        self.embed_timestep = nn.Embedding(max_ep_len, dim)
        self.embed_return = nn.Linear(1, dim)
        self.embed_action = nn.Linear(act_dim, dim)
        if tit:
            self.obs_patch_embed = nn.Conv1d(1, dim, state_dim, stride=state_dim, bias=False)
            self.class_token_encoding = nn.Parameter(torch.randn(1, 1, dim))
            self.inner_blocks = nn.ModuleList([ReferenceBlock(dim, 1, 1, "relu")])
        else:
            self.embed_state = nn.Linear(state_dim, dim)
        self.embed_ln = nn.LayerNorm(dim)
        # Not at the top: it takes seconds to import, in every process that collects tests.
        from transformers import GPT2Config, GPT2Model

        settings: dict[str, Any] = {
            "vocab_size": 1,
            "n_embd": dim,
            "n_layer": layers,
            "n_head": heads,
            "n_inner": inner,
            "activation_function": activation,
            "attn_implementation": "eager",
        }
        self.transformer = GPT2Model(GPT2Config(**settings))
        self.predict_state = nn.Linear(dim, state_dim)
        self.predict_action = nn.Sequential(nn.Linear(dim, act_dim), nn.Tanh())
        self.predict_return = nn.Linear(dim, 1)
        randomize(self)
        nn.init.zeros_(self.transformer.wpe.weight)  # the authors' copy of GPT-2 has no positions

    def params(self) -> dict[str, Tensor]:
        """The parameters, and the buffers of the authors' older GPT-2: its causal mask."""
        buffers = {"bias": torch.ones(1, 1, 8, 8).tril(), "masked_bias": torch.tensor(-1e4)}
        layers = range(len(self.transformer.h))
        masks = {f"transformer.h.{n}.attn.{k}": x for n in layers for k, x in buffers.items()}
        return {**self.state_dict(), **masks}

    def embed_states(self, states: Tensor) -> Tensor:
        if not self.tit:
            return self.embed_state(states)
        patches = self.obs_patch_embed(states.reshape(-1, 1, states.shape[-1])).mT  # [N, 1, D]
        x = torch.cat([self.class_token_encoding.expand(len(patches), -1, -1), patches], 1)
        for block in self.inner_blocks:
            x, _ = block(x)
        return x[:, 0].reshape(*states.shape[:-1], -1)

    def forward(
        self, states: Tensor, actions: Tensor, returns: Tensor, timesteps: Tensor, mask: Tensor
    ) -> Tensor:
        time = self.embed_timestep(timesteps)
        embedded = [
            self.embed_return(returns),
            self.embed_states(states),
            self.embed_action(actions),
        ]
        tokens = torch.stack([token + time for token in embedded], 2).flatten(1, 2)  # [B, 3K, D]
        x = self.transformer(
            inputs_embeds=self.embed_ln(tokens), attention_mask=mask.repeat_interleave(3, 1)
        ).last_hidden_state
        return self.predict_action(x[:, 1::3])


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
        ({"layers": 3, "dim": 128, "inner": 512}, 20),  # the protocol's
        ({"layers": 4, "heads": 4, "dim": 32}, 20),
        ({"layers": 2, "heads": 8, "inner": 40, "activation": "gelu_new"}, 7),
        ({"activation": "tanh", "heads": 16, "max_ep_len": 1000, "dim": 48}, 1),
    ],
)
def test_outputs_and_gradients_are_equal(kind: str, settings: dict[str, Any], steps: int) -> None:
    reference = ReferenceDT(11, 3, tit=kind == "dt_tit", **settings)
    params = reference.params()
    short = {
        "kind": kind,
        "n_head": settings.get("heads", 1),
        "activation": settings.get("activation", "relu"),
        "context": steps,
    }
    config = {
        **short,
        "state_dim": 11,
        "act_dim": 3,
        "embed_dim": settings.get("dim", 16),
        "n_layer": settings.get("layers", 1),
        "n_inner": settings.get("inner", 64),
        "max_ep_len": settings.get("max_ep_len", 50),
    }
    prefixed = {f"model.{name}": value for name, value in params.items()}
    networks = from_official(config, params), from_official(short, prefixed)
    states, *others, mask = make_inputs(4, steps, 11, 3, config["max_ep_len"])
    valid = mask.bool()
    results = []
    for module in (reference, *networks):
        given = states.clone().requires_grad_()
        actions = module.double().eval()(given, *others, mask)
        assert actions.isfinite().all()
        probe = torch.randn(actions.shape, generator=torch.Generator().manual_seed(0)).double()
        (actions * probe)[valid].sum().backward()
        results.append((actions[valid].detach(), given.grad))
    expected, *ours = results
    assert expected[0].std() > 0.01
    for found in ours:
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@KINDS
def test_a_missing_attention_bias_is_said(kind: str) -> None:
    reference = ReferenceDT(11, 3, tit=kind == "dt_tit", layers=2)
    params = {n: p for n, p in reference.params().items() if not n.endswith("attn.bias")}
    names = [f"transformer.h.{layer}.attn.c_attn.bias" for layer in range(2)]
    with pytest.warns(UserWarning, match=", ".join(names)) as warnings:
        network = from_official({"kind": kind}, params).double().eval()
    assert warnings[0].filename == __file__
    for name in names:
        torch.nn.init.zeros_(reference.get_parameter(name))
    inputs = make_inputs(1, 5, 11, 3, 50)
    expected = reference.double().eval()(*inputs)
    torch.testing.assert_close(network(*inputs), expected, rtol=0, atol=1e-9)


@KINDS
def test_what_does_not_fit_is_named(kind: str) -> None:
    params = ReferenceDT(11, 3, tit=kind == "dt_tit").params()
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
    for entry, meant in {"n_heads": "n_head", "activation_function": "activation"}.items():
        with pytest.raises(ValueError, match=f"has no '{entry}': write '{meant}"):
            from_official({"kind": kind, entry: 1}, params)
    with pytest.raises(ValueError, match=r"there is no parameter"):
        from_official({"kind": kind}, {})
