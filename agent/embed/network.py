"""What a node in C has to know of its network to take part in a run: names, whom it hears, losses of the model."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version
from typing import Any

import numpy as np

from agent.contract.gains import Gains, NodeGains
from agent.embed.names import Names
from agent.embed.source import filled, number, widths


def network_header(gains: Gains, names: Names, own: NodeGains, dtype: np.dtype[Any]) -> str:
    """The header of a program that is this node and no other."""
    problem, place = gains.problem, {sender: j for j, sender in enumerate(names.senders)}
    links, double = problem.links or (), np.dtype(np.float64)
    lossy = [
        f"    {{{draw}, {place[link.sender]}, {number(link.delivery_probability, double)}}} /* from {link.sender} */"
        for draw, link in enumerate(links)
        if link.receiver == own.node and link.sender in place
    ]
    hears = [{link.sender for link in own.links[mode]} for mode in names.modes]
    return filled(
        "run.h.in", gains, names, dtype, name=own.node, version=version("peakmesh"), nodes=problem.n,
        draws=len(links), lossy=len(lossy), node_names=_strings(problem.node_names),
        sender_names=_strings(names.senders), mode_names=_strings(names.modes),
        widths=", ".join(str(widths(own)[sender]) for sender in names.senders),
        hears=",\n".join(f"    {{{', '.join(str(int(sender in heard)) for sender in place)}}}" for heard in hears),
        links=",\n".join(lossy) or "    {0, 0, 1.0}",
    )  # fmt: skip


def _strings(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)
