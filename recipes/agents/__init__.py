"""Trained agents: from a run to an agent's files, and from either to a policy that acts.

The folders and how they are found are the library's: :mod:`torchrl_tit.agents`, which calls what
stands here.
"""

from .building import agent_from_files, agent_from_run
from .packing import pack

__all__ = ["agent_from_files", "agent_from_run", "pack"]
