"""Packages of the extra "recipes" that training needs and acting does not; see :mod:`extras`."""

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
