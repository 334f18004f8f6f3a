"""Frame encoders of several observations: by name, or by kind."""

from dataclasses import replace

import pytest
import torch
from torchrl.data import MultiCategorical

from torchrl_tit.networks import HistoryNetwork, build_network, chosen_by_kind, frames_by_kind
from torchrl_tit.settings import NETWORKS, Flat, Inner, Linear, NatureCNNFrames, ResNetFrames
from torchrl_tit.settings.networks import catformer, enhanced_tit, mlp, nature_cnn

DIRECTION = MultiCategorical([4])
GRID = {"image": (3, 7, 7), "direction": DIRECTION}
ROBOT = {"pixels": (3, 96, 96), "arm/left": (7,), "goal": MultiCategorical([4, 3])}


def test_what_reads_everything_is_what_the_settings_say():
    tit = enhanced_tit(embed_dim=8)
    assert frames_by_kind(tit, GRID) == dict.fromkeys(GRID, tit.frame)
    assert chosen_by_kind(tit, frames_by_kind(tit, GRID)) == ""
    assert frames_by_kind(mlp(), DIRECTION) == {"observation": Flat()}


def test_a_patch_that_does_not_fit_one_of_several_is_chosen():
    tit, auto = enhanced_tit(patch_size=12), enhanced_tit(patch_size="auto")
    frames = frames_by_kind(tit, GRID)
    assert frames == {"image": auto.frame, "direction": tit.frame}
    assert chosen_by_kind(tit, frames) == "image: inner (patch_size auto)"
    # There are too many pixels for a patch each.
    assert frames_by_kind(enhanced_tit(patch_size=1), ROBOT)["pixels"] == auto.frame
    with pytest.raises(ValueError, match="patch_size 12 is larger than the image of 7 x 7"):
        build_network(enhanced_tit(patch_size=12), GRID["image"])


def test_flat_frames_of_several_become_tokens():
    linear, cnn = Linear(embed_dim=64, bias=True), NatureCNNFrames(embed_dim=64)
    expected = {"pixels": cnn, "arm/left": linear, "goal": linear}
    assert frames_by_kind(mlp(), ROBOT) == expected
    small = Inner(embed_dim=64, patch_size="auto", every_block=False)
    assert frames_by_kind(mlp(), GRID) == {"image": small, "direction": linear}


def test_those_by_name_decide_the_width_of_the_others():
    network = replace(mlp(), frames={"direction": Linear(embed_dim=16)})
    frames = frames_by_kind(network, GRID)
    assert list(frames) == list(GRID)
    assert frames["image"] == Inner(embed_dim=16, patch_size="auto", every_block=False)
    assert frames["direction"] == Linear(embed_dim=16)
    resnet = frames_by_kind(catformer(embed_dim=20), {"pixels": (8, 8), "state": (3,)})
    assert resnet == {
        "pixels": ResNetFrames(embed_dim=20),
        "state": Linear(embed_dim=20, bias=True),
    }


def test_a_single_observation_can_be_named():
    for name, observation in [("observation", (6,)), ("state", {"state": (6,)})]:
        network = replace(mlp(), frames={name: Linear(embed_dim=5)})
        assert frames_by_kind(network, observation) == {name: Linear(embed_dim=5)}


@pytest.mark.parametrize(
    "system", [name for name in NETWORKS if name not in ("nature-cnn", "resnet")]
)
def test_every_system_reads_images_arrays_and_categories_at_once(system):
    network = replace(NETWORKS[system](2), frames={})
    with torch.device("meta"):
        trunk = build_network(network, GRID | {"state": (5,)}, action_dim=2, trunks="shared")
    assert isinstance(trunk, HistoryNetwork)
    assert list(trunk.frame_settings) == ["image", "direction", "state"]


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ({"imag": Inner()}, "frames names the observation 'imag', which .*: did you mean image?"),
        ({"image": NatureCNNFrames()}, "observation 'image': images of 7 x 7 pixels are too small"),
        ({"image": Inner(patch_size=3)}, "observation 'image': patch_size 3 does not divide"),
        ({"image": Linear(embed_dim=8)}, r"widths 8 \(image\) and 32 \(direction\) cannot stand"),
        ({"direction": ResNetFrames()}, r"'direction': resnet frames do not read a row of categ"),
    ],
)
def test_names_and_encoders_that_do_not_fit(frames, message):
    with pytest.raises(ValueError, match=message) as error:
        build_network(replace(enhanced_tit(), frames=frames), GRID)
    assert "\n" not in str(error.value)


def test_stacked_frames_are_those_of_one_observation():
    with pytest.raises(ValueError, match=r"stacked-cnn stacks .* several \(image, direction\)"):
        frames_by_kind(nature_cnn(), GRID)


def test_nothing_reads_an_image_whose_sides_no_patch_divides():
    task = {"image": (97, 35), "state": (3,)}
    with pytest.raises(
        ValueError,
        match=r"no frame encoder here reads image, an image of shape .*"
        r"--backbone.frames.image.*--observation-keys.*resize them",
    ):
        frames_by_kind(mlp(), task)
