"""The extras: packages that only some uses need, and what to say where one is missing."""

from __future__ import annotations

from typing import NoReturn

EXTRAS = {
    "ale_py": "atari",
    "captum": "explain",
    "filelock": "recipes",
    "h5py": "offline",
    "huggingface_hub": "share",
    "imageio_ffmpeg": "render",
    "jinja2": "report",
    "matplotlib": "recipes",
    "minari": "offline",
    "minatar": "minatar",
    "minigrid": "minigrid",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "onnxscript": "onnx",
    "optuna": "tune",
    "popgym": "popgym",
    "pytorch_optimizer": "offline",
    "ray": "ray",
    "scipy": "recipes",
    "tensorboard": "recipes",
    "tqdm": "recipes",
    "tyro": "recipes",
    "wandb": "wandb",
}
"""The extra that installs each package, by the package's name in ``import``."""


def install(package: str) -> str:
    """Returns the command that installs a package of an extra.

    Example:
        >>> install("h5py")
        "pip install 'torchrl-tit[offline]'"
    """
    return f"pip install 'torchrl-tit[{EXTRAS[package]}]'"


def missing(package: str) -> str:
    """Returns what to say where a package of an extra is not installed.

    Example:
        >>> missing("h5py")
        "h5py is not installed: pip install 'torchrl-tit[offline]'"
    """
    return f"{package} is not installed: {install(package)}"


class Missing:
    """Stands in for a package that is not installed; its first use names the extra.

    A module that needs an extra in some of its functions can thus be imported without it.

    Args:
        package: the package's name, a key of :data:`EXTRAS`.

    Example:
        >>> h5py = Missing("h5py")
        >>> h5py.File
        Traceback (most recent call last):
        ...
        ModuleNotFoundError: h5py is not installed: pip install 'torchrl-tit[offline]'
    """

    def __init__(self, package: str) -> None:
        self._package = package

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):  # asked for by inspect and copy, which are no use of it
            raise AttributeError(name)
        raise ModuleNotFoundError(missing(self._package), name=self._package)
