"""Route graphs of Nav2: places where the robot may turn, and straight drives between them with their costs.

A graph is drivable as it is: at each node the robot may turn on the spot through the whole circle, and along an edge it
drives straight ahead, from its start to its end. Edges are directed, since a drive that passes may fail the other way.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from travjax.config import require, require_number
from travjax.files import atomic_write
from travjax.jax_flags import usual_flags
from travjax.plan_results.path_files import feature
from travjax.planning.judges import MarginJudge
from travjax.planning.planner import Planner
from travjax.site.kernel import WIDEST, SiteSetup, site_margins
from travjax.site.primitives import Primitive

USUAL_SPACING = 2.0
"""Metres, about, between nodes unless something else is wanted."""

DIRECTIONS = ((1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1))
"""Rows and columns to the neighbours of a node, anticlockwise from +y."""

COARSE = 0.01
"""Metres: coordinates that Nav2 rounds by more get a line that says so."""


@dataclass(frozen=True, eq=False)
class RouteGraph:
    """Nodes and directed edges; n of those and e of these.

    nodes: [n, 2] x and y in metres, in coordinates of the site; frame: of these coordinates in ROS
    edges: [e, 2] numbers of the nodes where each begins and ends
    cost:  [e] as of Motions: length times 1 + risk * r^2, r the largest margin as a share of its limit
    """

    nodes: Float[np.ndarray, "n 2"]
    frame: str
    edges: Int[np.ndarray, "e 2"]
    cost: Float[np.ndarray, " e"]

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about what Nav2 makes of it."""
        rounded = float(np.spacing(np.float32(np.abs(self.nodes).max()))) / 2
        if rounded <= COARSE:
            return ()
        return (
            f"route graph: Nav2 keeps coordinates in four bytes, here to {rounded:.2g} m; a site whose coordinates "
            "count from an origin nearby has none of that",
        )


@usual_flags()
def route_graph(planner: Planner, spacing: float | None = None) -> RouteGraph:
    """Returns the route graph of a planner's site, by exact margins of the site kernel.

    spacing: metres between nodes, a whole number of strides; about 2 unless given
    Unknown ground is driven on only if the planner has an unknown_cost.
    Raises InputError where the robot's motions have no point turns or no straight drives, for other spacings, and where
    the robot cannot drive from any node to another.
    """
    lattice, setup, ground = planner.lattice, planner.setup, planner.costs.ground
    motions = lattice.motions
    require(motions.point_turns, "point_turns", motions.point_turns, "true for a route graph, at whose nodes one turns")
    require(lattice.headings > 1, "headings", lattice.headings, "2 or more for a route graph, at whose nodes one turns")
    require(0 in motions.turns, "turns", motions.turns, "such that 0, straight on, is among them for a route graph")
    spacing = math.ceil(USUAL_SPACING / setup.stride - 1e-6) * setup.stride if spacing is None else spacing
    _require_spacing(spacing, setup)
    nodes = replace(setup, stride=spacing)
    angles = [math.tau * number / len(DIRECTIONS) for number in range(len(DIRECTIONS))]
    lengths = [spacing * math.hypot(*direction) for direction in DIRECTIONS]
    drives = tuple(Primitive(angle, ((math.inf, length),)) for angle, length in zip(angles, lengths, strict=True))
    judge = MarginJudge(ground, setup, lattice, planner.unknown_cost)  # whatever that of the planner is
    straight = replace(nodes, primitives=drives)
    ahead, _ = judge.judged(lambda heights: site_margins(heights, straight), turning=False)
    turns = replace(nodes, primitives=tuple(turn.primitive for turn in lattice.point_turns))
    around, _ = judge.judged(lambda heights: site_margins(heights, turns), turning=True)
    place = np.full(around.shape[1:], -1)  # number of the node there
    rows, cols = np.nonzero(np.isfinite(around).all(axis=0))
    place[rows, cols] = np.arange(len(rows))
    edges, cost = _edges(place, ahead * np.array(lengths)[:, None, None])
    allowed = "such that a straight drive leads from some place where the robot can turn to another; it can turn at"
    require(len(edges) > 0, "route graph, spacing", spacing, f"{allowed} {len(rows)} of {place.size} places")
    at = np.array(ground.origin) + spacing * np.stack([cols, rows], axis=1)
    return RouteGraph(at, ground.frame or "map", edges, cost)


def _require_spacing(spacing: float, setup: SiteSetup) -> None:
    """Raises InputError unless nodes can be so far apart; setup: of the robot that stands still."""
    diagonal = (WIDEST // 2 - setup.grid.cells // 2) * setup.spacing
    most = math.floor(diagonal / math.sqrt(2) / setup.stride) * setup.stride
    allowed = f"a whole number of strides, {setup.stride:g} m each, of at most {most:g} m"
    require_number("route graph, spacing", spacing, 0, most, allowed)
    strides = spacing / setup.stride
    require(round(strides) >= 1 and abs(strides - round(strides)) < 1e-6, "route graph, spacing", spacing, allowed)


def _edges(
    place: Int[np.ndarray, "rows cols"], cost: Float[np.ndarray, "8 rows cols"]
) -> tuple[Int[np.ndarray, "e 2"], Float[np.ndarray, " e"]]:
    """Returns the edges and their costs, those of a node together; place: number of the node there, -1 for none."""
    around = np.pad(place, 1, constant_values=-1)
    ends = np.stack([around[1 + row :, 1 + col :][: len(place), : place.shape[1]] for row, col in DIRECTIONS])
    drivable = (place >= 0) & (ends >= 0) & np.isfinite(cost)
    row, col, direction = np.moveaxis(drivable, 0, -1).nonzero()
    edges = np.stack([place[row, col], ends[direction, row, col]], axis=1)
    return edges, cost[direction, row, col]


def save_route_graph(file: Path, graph: RouteGraph) -> Path:
    """Writes a route graph as the GeoJSON of Nav2's route server, whole or not at all; returns the file.

    Coordinates are metres in the graph's frame. Nav2 takes the costs as they are: without "overridable": false its edge
    scorers would replace them by lengths.
    """
    with atomic_write(file) as temporary, temporary.open("w", encoding="utf-8") as text:
        text.write('{"type": "FeatureCollection", "features": [\n')
        for number, feature in enumerate(_features(graph)):
            text.write((",\n" if number else "") + json.dumps(feature, allow_nan=False))
        text.write("\n]}\n")
    return file


def _features(graph: RouteGraph) -> Iterator[dict]:
    """Yields nodes and edges, each with a number of its own."""
    places = np.round(graph.nodes, 4).tolist()
    for number, place in enumerate(places):
        yield feature("Point", place, {"id": number, "frame": graph.frame})
    for number, ((start, end), cost) in enumerate(zip(graph.edges.tolist(), graph.cost.tolist(), strict=True)):
        ends = {"id": len(places) + number, "startid": start, "endid": end}
        yield feature("LineString", [places[start], places[end]], ends | {"cost": round(cost, 4), "overridable": False})
