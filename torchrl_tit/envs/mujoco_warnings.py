"""MuJoCo's warnings, each of them once."""

import logging

_shown: set[str] = set()


def show_mujoco_warnings_once() -> None:
    """Logs each of MuJoCo's warnings once in a process, as the logger ``torchrl_tit.mujoco``.

    MuJoCo itself prints them over and over, one for each environment that is built from a model
    that its newest version finds fault with, say, and writes them into MUJOCO_LOG.TXT in the
    working directory: a long run would fill both. A handler of the user's own stays.

    Example:
        >>> import mujoco
        >>> show_mujoco_warnings_once()
        >>> mujoco.get_mju_user_warning() is not None
        True
    """
    import mujoco  # here: most tasks do without it

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(text: str) -> None:
    # Not warnings.warn: where warnings are errors, an exception in here would end the process.
    if text not in _shown:
        _shown.add(text)
        logging.getLogger("torchrl_tit.mujoco").warning("MuJoCo: %s", text)
