"""Shows what a trained network attends to: maps, attention, and flows of information.

Grad-CAM on images, integrated gradients on arrays, attention of inner and outer blocks, and the
paper's table of information flows (arXiv 2212.14538, appendices on visualization and information
flow). docs/analysis.md explains how to read them.
"""

from torchrl_tit.analysis.attention import (
    inner_attention,
    map_attention,
    outer_attention,
    outer_weights,
    roll_out,
)
from torchrl_tit.analysis.flows import Flows, count_flows, flow_table
from torchrl_tit.analysis.grad_cam import grad_cam
from torchrl_tit.analysis.integrated_gradients import integrated_gradients
from torchrl_tit.analysis.targets import Target

__all__ = [
    "Flows",
    "Target",
    "count_flows",
    "flow_table",
    "grad_cam",
    "inner_attention",
    "integrated_gradients",
    "map_attention",
    "outer_attention",
    "outer_weights",
    "roll_out",
]
