"""What works without the extras, and what is said where one is missing."""

import re
import subprocess
import sys
from pathlib import Path

from torchrl_tit.extras import EXTRAS

ROOT = Path(__file__).parents[1]

BARE = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(EXTRAS)}))  # these cannot be imported
import recipes  # those of this clone
"""
USES = """
from recipes.cli.main import main

main(["list", "ppo/cartpole/"])
main(["play", "cartpole", "--episodes", "1"])
import torchrl_tit.datasets
import recipes.online_decision_transformer  # and with it, all that plays its agents
from recipes import Run, get_recipe
from recipes.core.metrics import Metrics
from pathlib import Path

def create():
    with Run(folder, get_recipe("ppo/cartpole/mlp")):
        pass

folder = sys.argv[1]
open(f"{folder}/data.hdf5", "w").close()
for use in (
    lambda: main(["train", "ppo/cartpole/mlp"]),
    lambda: main(["compare", folder]),
    lambda: main(["data", "info", f"{folder}/data.hdf5"]),
    lambda: torchrl_tit.datasets.load_episodes(f"{folder}/data.hdf5"),
    lambda: torchrl_tit.datasets.load_episodes("mujoco/hopper/medium-v0"),
    lambda: recipes.online_decision_transformer.make_lamb([], 1.0, 0.0),
    create,
    lambda: Metrics(Path(folder), [], 0),
):
    try:
        use()
    except ModuleNotFoundError as error:
        print("missing:", error)
    except SystemExit as stop:
        print("exit:", stop.code)
"""


def test_networks_and_trained_agents_need_no_extra(tmp_path: Path) -> None:
    text = (ROOT / "README.md").read_text().replace("500", "20")  # steps of an episode
    readme = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    result = subprocess.run(
        [sys.executable, "-c", "".join([BARE, *readme, USES]), str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )

    assert result.returncode == 0, result.stderr
    assert len(readme) == 2
    lines = result.stdout.splitlines()
    assert "tensor(20.)" in lines
    assert "ppo/cartpole/enhanced-tit" in lines
    assert any(line.startswith("cartpole: return 500 ") for line in lines)
    assert lines[-8:] == [
        "exit: 2",
        "exit: 2",
        "exit: 2",
        "missing: h5py is not installed: pip install 'torchrl-tit[offline]'",
        "missing: minari is not installed: pip install 'torchrl-tit[offline]'",
        "missing: pytorch_optimizer is not installed: pip install 'torchrl-tit[offline]'",
        "missing: filelock is not installed: pip install 'torchrl-tit[recipes]'",
        "missing: tensorboard is not installed: pip install 'torchrl-tit[recipes]'",
    ]
    assert [line for line in result.stderr.splitlines() if line.startswith("error: ")] == [
        "error: tyro is not installed: pip install 'torchrl-tit[recipes]'",
        "error: scipy is not installed: pip install 'torchrl-tit[recipes]'",
        "error: tyro is not installed: pip install 'torchrl-tit[recipes]'",
    ]
    assert "Traceback" not in result.stderr
