"""h5py and Minari, which the extra "offline" installs; without it, their first use says so."""

from torchrl_tit.extras import Missing

try:
    import h5py
except ModuleNotFoundError:
    h5py = Missing("h5py")
try:
    import minari
except ModuleNotFoundError:
    minari = Missing("minari")

__all__ = ["h5py", "minari"]
