"""The table of information flows of many networks, counted and measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace

from torchrl_tit import settings
from torchrl_tit.analysis.counted_flows import Flows, count_flows
from torchrl_tit.analysis.measured_flows import measure_flows
from torchrl_tit.networks import HistoryNetwork, build_network

_ARRAY, _IMAGE = (4,), (36, 36)
_SHORT = {"spatial": "spatial", "temporal": "temporal"} | {
    f"{a}_to_{b}": f"{a[0].upper()}-{b[0].upper()}"
    for a, b in [
        ("spatial", "spatial"),
        ("temporal", "temporal"),
        ("spatial", "temporal"),
        ("temporal", "spatial"),
    ]
}


def flow_table(networks: Mapping[str, settings.Network]) -> str:
    """Formats the flows of information of networks as a Markdown table.

    The numbers are those of :func:`~torchrl_tit.analysis.count_flows`. The last column has the T-T
    flows that :func:`~torchrl_tit.analysis.measure_flows` finds: blocks over the frames that read
    another one, and those that the output reads. If the measured number of any other flow differs,
    the cell has both: "2, measured 1".

    Args:
        networks: their settings by name. The networks are built for arrays of 4 entries, or for
            images of 36 x 36 pixels if they do not read arrays.

    Raises:
        ValueError: if a history encoder is one of a user's own, which no rule counts.

    Example:
        >>> from torchrl_tit.settings.networks import vanilla_tit
        >>> print(flow_table({"Vanilla_TIT": vanilla_tit(4)}))
        | network | K | spatial | temporal | S-S | T-T | S-T | T-S | T-T measured: blocks, output |
        |---|---|---|---|---|---|---|---|---|
        | Vanilla_TIT | 4 | 8 | 2 | 4 | 1 | 4 | 0 | 1, 1 |
    """
    names = [field.name for field in fields(Flows)]
    header = ["network", "K", *(_SHORT[name] for name in names), "T-T measured: blocks, output"]
    lines = [header, ["---"] * len(header)]
    for name, network in networks.items():
        counted = asdict(count_flows(network))
        measured = asdict(measure_flows(_build(network)))
        cells = [
            str(counted[flow])
            if flow == "temporal_to_temporal" or counted[flow] == measured[flow]
            else f"{counted[flow]}, measured {measured[flow]}"
            for flow in names
        ]
        found = f"{measured['temporal_to_temporal']}, {measured['temporal_to_output']}"
        lines.append([name, str(network.num_frames), *cells, found])
    rows = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([rows[0], rows[1].replace(" ", ""), *rows[2:]])


def _build(network: settings.Network) -> HistoryNetwork:
    """Builds a network; if it has two trunks, only one."""
    network = replace(network, trunks="shared")
    try:
        built = build_network(network, _ARRAY, action_dim=1)
    except ValueError:
        built = build_network(network, _IMAGE, action_dim=1)
    assert isinstance(built, HistoryNetwork)
    return built
