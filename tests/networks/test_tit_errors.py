"""What is wrong is refused early, with what was given, what was expected and what to do."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from torchrl_tit.networks import EnhancedTIT, VanillaTIT

BOTH = pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])

WRONG_SETTINGS: list[tuple[tuple[int, ...], int, dict[str, Any], str]] = [
    ((4,), 0, {}, r"num_frames must be at least 1, not 0"),
    ((4,), -1, {}, r"num_frames must be at least 1, not -1"),
    ((), 1, {}, r"observation_shape \(\) is not that of an array \(D,\) or an image"),
    ((0,), 1, {}, r"observation_shape \(0,\) is not"),
    ((1, 2, 3, 4), 1, {}, r"observation_shape \(1, 2, 3, 4\) is not"),
    ((4,), 1, {"num_heads_inner": 3}, r"width 32 cannot be split over 3 attention heads: choose"),
    ((4,), 1, {"num_heads_outer": 5}, r"width 32 cannot be split over 5 attention heads: choose"),
    ((4,), 1, {"num_heads_outer": 0}, r"num_heads must be at least 1, not 0"),
    ((8, 8), 1, {"patch_size": 9}, r"patch_size 9 is larger than the image of 8 x 8"),
    ((8, 4), 1, {"patch_size": 8}, r"patch_size 8 is larger than the image of 8 x 4"),
    ((9, 8), 1, {"patch_size": 4}, r"4 does not divide the image of 9 x 8 pixels: .* \[1\]"),
    ((3, 8, 18), 1, {"patch_size": 4}, r"4 does not divide the image of 8 x 18 .* \[1, 2\]"),
    ((4,), 1, {"activation_inner": "swish"}, r"'swish', not one of .*'gelu'"),
    ((4,), 1, {"activation_outer": "gelo"}, r"'gelo', not one of .*'gelu'"),
    ((4,), 1, {"activation_head": "Tanh"}, r"'Tanh', not one of .*'tanh'"),
    *(
        ((4,), 1, {f"{kind}_dropout_{part}": p}, rf"{kind}_dropout .* \[0, 1\), not {p}")
        for kind, part, p in [
            ("attention", "inner", -0.1),
            ("attention", "outer", 1.0),
            ("ffn", "inner", float("nan")),
            ("ffn", "outer", 1.0),
        ]
    ),
    *(
        ((4,), 1, {name: 0}, rf"{field} must be at least 1, not 0")
        for name, field in [
            ("patch_size", "patch_size"),
            ("embed_dim", "embed_dim"),
            ("num_blocks", "num_blocks"),
            ("ffn_expansion_inner", "ffn_expansion"),
            ("ffn_expansion_outer", "ffn_expansion"),
            ("features_dim", "features_dim"),
        ]
    ),
]


@BOTH
@pytest.mark.parametrize(("shape", "num_frames", "settings", "message"), WRONG_SETTINGS)
def test_wrong_settings(
    kind: type[Any], shape: tuple[int, ...], num_frames: int, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        kind(shape, num_frames, **settings)


def test_nothing_left() -> None:
    with pytest.raises(ValueError, match="inner and outer cannot both be off"):
        EnhancedTIT((4,), 2, inner=False, outer=False)
    with pytest.raises(ValueError, match="those of the outer blocks: set them to none"):
        EnhancedTIT((4,), 2, outer=False, temporal_positions="learned")


@pytest.mark.parametrize(
    "shape", [(3, 4), (3, 5), (2, 5, 3), (4,), (), (5, 3), (2, 4, 4), (2, 3, 5)]
)
@BOTH
def test_history_of_another_shape(kind: type[Any], shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 4, 3\]") as error:
        kind((3,), 4)(torch.zeros(shape))
    assert str(tuple(shape)) in str(error.value)


@BOTH
def test_image_of_another_shape(kind: type[Any]) -> None:
    tit = kind((8, 8), 2, patch_size=4)
    for call in (tit, tit.attention_maps):
        with pytest.raises(ValueError, match=r"\(5, 2, 8, 9\).* expected \[\.\.\., 2, 8, 8\]"):
            call(torch.zeros(5, 2, 8, 9))


@BOTH
@pytest.mark.parametrize("dtype", [torch.float64, torch.int64, torch.bool, torch.bfloat16])
def test_history_of_another_dtype(kind: type[Any], dtype: torch.dtype) -> None:
    tit = kind((3,), 2)
    hint = "give it uint8, or convert" if dtype.is_floating_point else "if it counts categories"
    for call in (tit, tit.attention_maps):
        with pytest.raises(TypeError, match=rf"{dtype} .* network of torch.float32: {hint}"):
            call(torch.zeros(5, 2, 3, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float64, torch.int64])
def test_autocast_does_not_convert_these(dtype: torch.dtype) -> None:
    tit = EnhancedTIT((3,), 2)
    with torch.autocast("cpu", torch.bfloat16), pytest.raises(TypeError, match=f"{dtype}"):
        tit(torch.zeros(5, 2, 3, dtype=dtype))
