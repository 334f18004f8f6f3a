"""Trained agents: from a run to an agent's files, and from either to a policy that acts.

The library, :mod:`torchrl_tit.agents`, finds and reads the folders, and calls these functions.
"""

from .building import agent_from_files, agent_from_run
from .packing import pack

__all__ = ["agent_from_files", "agent_from_run", "pack"]
