"""filelock and tqdm, which the extra "recipes" installs; without it, their first use says so.

Training needs them; loading a trained agent, which imports the same modules, does not.
"""

from torchrl_tit.extras import Missing

try:
    import filelock
except ModuleNotFoundError:
    filelock = Missing("filelock")  # type: ignore[assignment]
try:
    import tqdm
except ModuleNotFoundError:
    tqdm = Missing("tqdm")

__all__ = ["filelock", "tqdm"]
