"""MuJoCo's warnings, each shown once."""

import logging

_shown: set[str] = set()


def show_mujoco_warnings_once() -> None:
    """Logs each of MuJoCo's warnings once per process, with the logger ``torchrl_tit.mujoco``.

    By default MuJoCo prints a warning every time (for example, for each environment with an
    outdated model) and appends it to MUJOCO_LOG.TXT in the working directory, so both grow in a
    long run. A handler that the user has set is kept.

    Example:
        >>> import mujoco
        >>> show_mujoco_warnings_once()
        >>> mujoco.get_mju_user_warning() is not None
        True
    """
    import mujoco  # here, since most tasks do not need it

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(text: str) -> None:
    # Not warnings.warn: if warnings are errors, an exception in this callback ends the process.
    if text not in _shown:
        _shown.add(text)
        logging.getLogger("torchrl_tit.mujoco").warning("MuJoCo: %s", text)
