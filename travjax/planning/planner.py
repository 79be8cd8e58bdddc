"""The planner: from here to there on a site, or what stands in the way (SPEC section 14)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float

from travjax.config import InputError, require_number
from travjax.jax_flags import usual_flags
from travjax.planning.costs import MotionCosts
from travjax.planning.endpoints import Endpoint, endpoint, standing, why_not_standing
from travjax.planning.judges import Judge, MarginJudge
from travjax.planning.motions import MotionLattice, Motions
from travjax.planning.no_path import cannot_stand, no_path
from travjax.planning.path import Leg, Path, Stretch, drive
from travjax.planning.search import Search, bounds
from travjax.simulation.robot import Robot
from travjax.simulation.setup import chosen_robot
from travjax.site.ground import Site, open_site
from travjax.site.kernel import SiteSetup, contact_of
from travjax.site.primitives import PointTurn

Found = tuple[list[Leg], float, int]
"""Motions of a path, its cost, and the state where it begins."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A path that the robot survives, and how it was found.

    path:   its poses, each simulated once more by the sequential simulators
    legs:   the motions that it is made of
    cost:   as of Motions, the least that these motions allow
    points: where it begins, passes and ends, on the lattice
    found_by: what was searched, and what judged it
    refused: motions that the sequential simulators refused before
    """

    path: Path
    legs: tuple[Stretch, ...]
    cost: float
    points: tuple[Endpoint, ...]
    found_by: str
    refused: int

    @property
    def checks(self) -> dict[str, int]:
        """What the sequential simulators said, in words."""
        return {
            "poses simulated": len(self.path.z),
            "poses that exceed a limit": int(self.path.exceeds.sum()),
            "poses on unknown ground": int((~self.path.known).sum()),
            "motions refused before": self.refused,
        }


class Planner:
    """Plans paths on one site; what was computed for one is kept for the next."""

    def __init__(
        self,
        ground: Site,
        robot: Robot | str | None = None,
        motions: Motions | None = None,
        *,
        headings: int = 16,
        stride: float | None = None,
        contact: str | None = None,
        interval: float = 0.06,
        unknown_cost: float | None = None,
        judge: Callable[[Site, SiteSetup, MotionLattice], Judge] | None = None,
    ):
        """See `plan`; judge: makes the judge of motions, which goes by exact margins unless given."""
        chosen, spacing = chosen_robot(robot), ground.spacing
        places = SiteSetup.usual_stride(spacing) if stride is None else stride
        if unknown_cost is not None:
            require_number("unknown_cost", unknown_cost, np.nextafter(1, 0), 1e6, "a factor of at least 1")
        lattice = MotionLattice(motions or Motions(), headings, places)
        standing_still = (PointTurn(0.0),)
        self.setup = SiteSetup(chosen, standing_still, spacing, places, interval, contact_of(chosen, contact))
        self.unknown_cost = unknown_cost
        if judge is None:
            judge = partial(MarginJudge, unknown_cost=unknown_cost)
        self.costs = MotionCosts(ground, self.setup, lattice, judge(ground, self.setup, lattice))

    @property
    def lattice(self) -> MotionLattice:
        """States and motions."""
        return self.costs.lattice

    @property
    def method(self) -> str:
        """What figures say of it: what is searched, and what judges it."""
        lattice = self.lattice
        return f"{lattice.headings} headings, places {lattice.stride:g} m apart, {self.costs.judge.title}"

    @usual_flags()
    def plan(self, start: Any, goal: Any, via: Sequence[Any] = (), coordinates: str = "site") -> Plan:
        """Plans a path; see `plan`."""
        points = self.points(start, goal, via, coordinates)
        self.require_standing(points[0])
        with self.costs.watched("planning", whole=False):
            return self.checked(points, lambda: self.cheapest(points))

    def points(self, start: Any, goal: Any, via: Sequence[Any] = (), coordinates: str = "site") -> list[Endpoint]:
        """Returns the places of the lattice where a path begins, passes and ends; see `plan`."""
        names = ["start", *(f"via {number}" for number in range(1, len(via) + 1)), "goal"]
        given = zip(names, (start, *via, goal), strict=True)
        return [endpoint(name, point, self.costs, coordinates) for name, point in given]

    def require_standing(self, start: Endpoint) -> None:
        """Raises InputError that says why the robot cannot stand at the start of a path, and where it could."""
        if not standing(start, self.costs):
            raise InputError(why_not_standing(start, self.costs))

    def checked(self, points: Sequence[Endpoint], find: Callable[[], Found]) -> Plan:
        """Finds motions, simulates their poses once more, and goes on without those that the simulators refuse."""
        before = self.costs.refused
        while True:
            legs, cost, first = find()
            path, owner = drive(legs, self.pose_of(first), self.costs.ground, self.setup)
            judge = self.costs.judge
            bad = path.exceeds if judge.unknown_allowed else path.exceeds | ~path.known
            if not (judge.final and legs and bad.any()):
                break
            for number in {owner[row] for row in np.flatnonzero(bad)}:
                self.costs.block(legs[number])
        return Plan(path, tuple(legs), cost, tuple(points), self.method, self.costs.refused - before)

    def cheapest(self, points: Sequence[Endpoint]) -> Found:
        """Returns the motions of the cheapest path, its cost, and the state where it begins."""
        starts = dict.fromkeys(standing(points[0], self.costs), 0.0)
        searches, goals = [], []
        for here, there in zip(points, points[1:], strict=False):
            goals = standing(there, self.costs)
            if not goals:
                raise cannot_stand(here, there, self.costs)
            bound = bounds(self.lattice, self.costs.easiest, [there.row * self.costs.shape[1] + there.col])
            search = Search(self.lattice.moves, self.lattice.headings, bound)
            for state, cost in starts.items():
                search.start(state, cost)
            if not search.run(self.costs, goals, every=there is not points[-1]):
                raise no_path(here, there, self.costs, search)
            starts = {goal: float(search.best[goal]) for goal in goals if search.closed[goal]}
            searches.append(search)
        state = min(starts, key=lambda goal: starts[goal])
        cost, legs = starts[state], list[Leg]()
        for search in reversed(searches):
            steps = search.path_to(state)
            legs[:0] = [self.leg(search, *step) for step in steps]
            state = steps[0][0] if steps else state
        return legs, cost, state

    def pose_of(self, state: int) -> Float[np.ndarray, " 3"]:
        """Returns x and y of a state in metres from the site's south-west node, and its heading in radians."""
        place, heading = divmod(state, self.lattice.headings)
        row, col = divmod(place, self.costs.shape[1])
        return np.array([col * self.setup.stride, row * self.setup.stride, self.lattice.angles[heading]])

    def leg(self, search: Search, state: int, heading: int, step: int) -> Leg:
        """Returns the motion of a step of a search from a state."""
        moves = search.moves
        row, col = divmod(state // self.lattice.headings, self.costs.shape[1])
        begins = row + int(moves.from_rows[heading, step]), col + int(moves.from_cols[heading, step])
        return Leg(*begins, self.lattice.all[moves.motion[heading, step]], bool(moves.backwards[heading, step]))


def plan(
    site: str | FilePath | Site | Float[np.ndarray, "rows cols"],
    start: Any,
    goal: Any,
    robot: Robot | str | None = None,
    *,
    via: Sequence[Any] = (),
    motions: Motions | None = None,
    headings: int = 16,
    stride: float | None = None,
    spacing: float | None = None,
    contact: str | None = None,
    interval: float = 0.06,
    unknown_cost: float | None = None,
    coordinates: str = "site",
) -> Plan:
    """Plans the cheapest path that a robot survives, and simulates each of its poses once more.

    site:        an elevation map that `load_dem` reads, a `SiteGround`, or heights [rows, cols] in metres, row 0 south
    start, goal: (x, y) or (x, y, heading), radians anticlockwise from +y (north); any heading unless given. The path
                 begins and ends at the nearest places of a lattice and in the nearest of its headings
    robot:       a Robot, or the name or file of one; the Seekur Jr unless given
    via:         points to pass in this order
    motions:     what the robot may do, and what that costs
    headings:    number of headings, evenly around the circle; stride: metres between places (0.25); spacing: metres
                 between nodes (0.0625); interval: metres between simulated poses
    contact:     contact model, "tyre" or "nearest"; that of the robot's file unless given, or else "tyre"
    unknown_cost: how many times as much as the worst safe ground unknown ground costs; it is not driven on unless given
    coordinates: what points are: "site" (x and y), "latlon" (degrees of latitude and longitude) or "rowcol" (row and
                 column of nodes, counted from the south-west)
    Source: SPEC section 14. Raises NoPathError where there is no path, and InputError as `map_site` does, for points
    off the site, and where the robot cannot stand at the start.
    """
    planner = Planner(
        open_site(site, spacing),
        robot,
        motions,
        headings=headings,
        stride=stride,
        contact=contact,
        interval=interval,
        unknown_cost=unknown_cost,
    )
    return planner.plan(start, goal, via, coordinates)
