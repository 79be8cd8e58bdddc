"""Splits a network into its static part and the variables that training changes."""

from typing import Any

from flax import nnx

VARIABLES = ("trunk", "heads", "statistics")
"""Names of the variables that training changes: parameters of trunk and heads, and running means and variances."""

Network = nnx.Module
"""An estimator's network, of any kind."""

Variables = dict[str, nnx.State]
"""The variables of a network by the names of VARIABLES."""


def split_model(network: Network) -> tuple[nnx.GraphDef, Variables]:
    """Returns the static part of a network, and its VARIABLES.

    Parameters below `heads` belong to the heads, all others to the trunk; a network may lack either.
    """
    heads = nnx.PathContains("heads")
    graph, *states = nnx.split(network, nnx.All(nnx.Param, nnx.Not(heads)), nnx.All(nnx.Param, heads), nnx.BatchStat)
    return graph, dict(zip(VARIABLES, states, strict=True))


def merge_model(graph: nnx.GraphDef, variables: Variables) -> Any:
    """Inverts `split_model`; the network gets its own copy of the variables."""
    return nnx.merge(graph, *(variables[name] for name in VARIABLES), copy=True)
