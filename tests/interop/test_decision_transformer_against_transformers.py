"""Decision Transformer against GPT-2 of the transformers library, with the same weights.

The authors' network is GPT-2 of that library without its position embeddings, so this holds where
its weights are at hand in full: more layers, heads, widths and activations than one file has.
"""

from __future__ import annotations

import logging
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.interop.test_official_decision_transformer import make_inputs
from tests.networks.reference import randomize
from tests.networks.reference_decision_transformer import ReferenceDT
from torchrl_tit.interop import from_official
from torchrl_tit.interop.decision_transformer import ActionPredictor

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

logging.getLogger("transformers").setLevel(logging.ERROR)


class TransformersDT(ReferenceDT):
    """The reference's embeddings and heads around the library's GPT-2."""

    def __init__(
        self,
        *,
        tit: bool,
        dim: int = 16,
        layers: int = 1,
        heads: int = 1,
        inner: int = 64,
        activation: str = "relu",
    ) -> None:
        super().__init__(11, 3, tit=tit, dim=dim)
        settings: dict[str, Any] = {
            "vocab_size": 1,
            "n_embd": dim,
            "n_layer": layers,
            "n_head": heads,
            "n_inner": inner,
            "activation_function": activation,
            "attn_implementation": "eager",
        }
        # Not at the top: it takes seconds to import, in every process that collects tests.
        from transformers import GPT2Config, GPT2Model

        config = GPT2Config(**settings)
        self.gpt2 = GPT2Model(config)
        self.transformer = nn.ModuleDict()
        randomize(self)
        nn.init.zeros_(self.gpt2.wpe.weight)  # the authors' copy of GPT-2 has no positions

    def official_state_dict(self) -> dict[str, Tensor]:
        """Weights under the authors' names."""
        return {
            name.replace("gpt2.", "transformer."): weight
            for name, weight in self.state_dict().items()
        }

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
        x = self.gpt2(
            inputs_embeds=self.embed_ln(tokens), attention_mask=mask.repeat_interleave(3, 1)
        ).last_hidden_state
        return self.predict_action(x[:, 1::3])


@pytest.mark.parametrize("kind", ["dt", "dt_tit"])
@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({}, 5),
        ({"layers": 3, "dim": 128, "inner": 512}, 20),  # the protocol's
        ({"layers": 4, "heads": 4, "dim": 32}, 20),
        ({"layers": 2, "heads": 8, "inner": 40, "activation": "gelu_new"}, 7),
    ],
)
def test_outputs_and_gradients_are_equal(kind: str, settings: dict[str, Any], steps: int) -> None:
    reference = TransformersDT(tit=kind == "dt_tit", **settings).eval()
    config = {
        "kind": kind,
        "n_head": settings.get("heads", 1),
        "activation": settings.get("activation", "relu"),
        "context": steps,
    }
    network = from_official(config, reference.official_state_dict()).double().eval()
    reference.double()
    assert isinstance(network, ActionPredictor)
    blocks = network.network.history_encoder.get_submodule("blocks")
    assert isinstance(blocks, nn.ModuleList)
    assert len(blocks) == settings.get("layers", 1)
    states, *others, mask = make_inputs(4, steps, 11, 3, 50)
    valid = mask.bool()
    results = []
    for module in (network, reference):
        given = states.clone().requires_grad_()
        actions = module(given, *others, mask)[valid]
        probe = torch.randn(actions.shape, generator=torch.Generator().manual_seed(0)).double()
        (actions * probe).sum().backward()
        results.append((actions.detach(), given.grad))
    (ours, our_gradient), (theirs, their_gradient) = results
    assert theirs.std() > 0.1
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    torch.testing.assert_close(our_gradient, their_gradient, rtol=1e-9, atol=1e-9)
