"""Commands that cannot work say why in one line, and write nothing."""

import shlex

import pytest

from recipes.core.run import Run
from tests.agents.runs import make_run
from tests.datasets.rollouts import roll, write
from tests.recipes.commands import fails

TIT, MLP = "ppo/cartpole/enhanced-tit", "ppo/cartpole/mlp"
EXPLAIN, BACKBONE = "explain run --out", f"train {TIT} --backbone"

MISTAKES = [
    ("fly", "unknown command 'fly'"),
    ("trian", "unknown command 'trian': did you mean train"),
    ("list atlantis", "no recipe's name contains 'atlantis'"),
    ("show nothing.json", "nothing.json"),
    ("train", "train needs the name of a recipe"),
    ("train .", ". is a folder, not a recipe"),
    ("train ppo/cartpole/enhanced-tt", "did you mean ppo/cartpole/enhanced-tit"),
    ("train --resume nowhere", "is not a run folder"),
    (f"train {TIT} --env CartPole-v7", "CartPole-v1"),
    (f"train {TIT} --num-envs 3", "num_envs 3 does not divide steps_per_batch 1024"),
    (f"train {MLP} --device vulkan", "from the 'Vulkan' backend): use 'cpu' or 'auto'"),
    (f"train {TIT} --critic-coeff 0", "critic_coeff must be positive, not 0.0"),
    ("train cql/hopper-medium-v0/mlp --total-steps 9", "runs is --total-updates"),
    ("train dt/hopper-medium-v2/dt --total_updates=9", "its runs is --iterations"),
    (f"{BACKBONE}.num-frames 0", "num_frames must be at least 1, not 0"),
    (f"{BACKBONE}.frame.num-heads 3", "width 32"),
    (f"{BACKBONE}.frame.patch-size 0", "patch_size"),
    (f"{BACKBONE}.frame resnt", "--backbone.frame has no choice 'resnt': did you mean resnet"),
    (f"{BACKBONE}.frame resnet", "take inner, linear or flat frames"),  # CartPole has no images
    (f"{BACKBONE}.frame linear --backbone.frame.num-blocks 2", "--backbone.frame.num-blocks"),
    (f"{BACKBONE}.frames.image innr", "--backbone.frames.image has no choice 'innr': did you mean"),
    (f"{BACKBONE}.frames.image inner", "names the observation 'image', which the task does not"),
    (f"{BACKBONE}.frames.image.patch-size x", "Error parsing --backbone.frames.image.patch-size"),
    (f"{BACKBONE}.history", "--backbone.history needs a name: choose from outer, paired-outer"),
    (f"{BACKBONE}.history --num-envs", "--backbone.history needs a name"),
    (f"{BACKBONE}.history out", "did you mean outer"),
    (f"{BACKBONE}.history catformer", "num_frames is 1: set it to 2 or more"),
    (f"{BACKBONE}.history decision-transformer", "use a dt or odt recipe"),
    (f"{BACKBONE}.network enhanced", "did you mean enhanced-tit"),
    (
        f"train {MLP} --env-settings a=1 --env-settings b=2",
        "--env-settings is there twice: type it",
    ),
    (
        f"train {MLP} --decay-learning-rate --no-decay_learning_rate",
        "--decay-learning-rate is there",
    ),
    ("summary run --networks mlp --networks=d2rl", "--networks is there twice"),
    ("evaluate nowhere", "is not a run folder"),
    ("evaluate run --dataset a.hdf5 --episodes 3", "--episodes are those that are played"),
    ("evaluate run --dataset a.hdf5 --seed 3", "--seed is for episodes or --ope"),
    (
        "evaluate run --dataset a.hdf5 --env Other-v0",
        "--env and --env-settings name what is played",
    ),
    (f"tune {MLP} --out new --seeds 0 -1", "seed must be at least 0, not -1"),
    (f"tune {MLP} --out new --epochs 4", "--epochs is searched, so it has no value: leave it out"),
    ("play cart", "no agent or folder 'cart': did you mean cartpole"),
    ("play empty", "holds no checkpoint: train the run first"),
    ("play run --episodes 0", "--episodes must be at least 1, not 0"),
    (f"play run --episodes {10**30}", "--episodes must be at most 100000, not 1000"),
    ("play run --seed -1", "--seed must be at least 0, not -1"),
    ("play run --out film.txt", "a film is one of .gif, .mp4"),
    ("share run", "share needs REPO, such as me/cartpole, or --out FOLDER"),
    ("share run --out new --private", "--private is for REPO on the Hub"),
    ("share empty --out new", "holds no checkpoint: train the run first"),
    ("share nowhere --out new", "there is no agent or folder"),
    ("share run --out run/recipe.json/new", "File exists: 'run/recipe.json'"),
    ("share run --out 'a b'", "name must be letters"),
    ("examples", "the following arguments are required: OUT"),
    ("examples run", "run exists already"),
    (
        "train ppo/cartpole/mlp --out mine.png/run",
        "'mine.png/run': a file is in the way, so choose",
    ),
    ("tune ppo/cartpole/mlp --out mine.png", "'mine.png': a file is in the way, so choose"),
    ("export empty --out a.pt2", "holds no checkpoint: train the run first"),
    ("export nothing --out a.pt2", "neither an agent nor a run"),
    ("export nobody --out a.pt2", "there is no agent or folder 'nobody'"),
    ("export run --out agent", "tells no format"),
    (f"{EXPLAIN} a.avi", "a picture of one step (.png), not 'a.avi'"),
    (f"{EXPLAIN} a.gif --step 3", "step 3 is one step"),
    (f"{EXPLAIN} a.gif --max-steps 0", "--max-steps must be at least 1, not 0"),
    (f"{EXPLAIN} a.png --max-steps 3", "max_steps 3 is the length of a film"),
    (f"{EXPLAIN} a.png --step -1", "--step must be at least 0, not -1"),
    (f"{EXPLAIN} a.png --seed -1", "--seed must be at least 0"),
    (f"{EXPLAIN} no/a.png", "there is no folder"),
    (f"{EXPLAIN} mine.png", "exists already"),
    ("explain nothing --out a.png", "is neither an agent nor a run"),
    ("explain empty --out a.gif", "holds no checkpoint"),
    ("play run --out mine.gif", "exists already"),
    ("play run --out no/a.gif", "a.gif cannot be written: there is no folder"),
    ("compare run --out curves.pdf", "--out curves.pdf must end in .png"),
    ("report run --out a.pdf", "a report is an .html file, not 'a.pdf'"),
    ("report run --out folder.html", "it is a folder"),
    ("report run --out no/a.html", "there is no folder"),
    ("data inspect", "invalid choice: 'inspect'"),
    ("data info", "the following arguments are required: source"),
    ("data info hopper", "'hopper' is not a data set"),
    ("data info a.hdf5 --env Walker2d-v5", "field 'observations': one row has the shape"),
    ("data convert a.hdf5 a.hdf5", "exists already"),
    ("data convert a.hdf5 unnumbered", "'unnumbered' is not a valid name"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run that can act, one without a checkpoint, data, and files of the user's own."""
    folder = tmp_path_factory.mktemp("mistakes")
    run = Run.open(make_run(folder / "run"))
    (run.folder / "metrics.csv").write_text("step,time,return_mean\n1,0,1.0\n")
    Run.create(folder / "empty", run.recipe)
    write(folder / "a.hdf5", roll())
    for name in ("nothing", "folder.html"):
        (folder / name).mkdir()
    for name in ("mine.png", "mine.gif"):
        (folder / name).write_bytes(b"mine")
    return folder


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_one_line_says_what_is_wrong(words, message, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    paths = [path for path in folder.rglob("*") if path.name != ".lock"]
    before = {path: path.is_file() and path.read_bytes() for path in paths}
    assert message in fails(capsys, *shlex.split(words))
    paths = [path for path in folder.rglob("*") if path.name != ".lock"]
    assert {path: path.is_file() and path.read_bytes() for path in paths} == before
