"""The cost to reach a goal from everywhere on a site: one search, backwards from the goal, answers all starts."""

from typing import Any

import numpy as np
from jaxtyping import Float

from travjax.jax_flags import usual_flags
from travjax.planning.endpoints import endpoint, standing
from travjax.planning.no_path import cannot_stand
from travjax.planning.planner import Found, Plan, Planner
from travjax.planning.search import NOWHERE, Search


class CostToGo:
    """The cost of the cheapest path to a goal from every state; rows of places run north, columns east.

    goal: where the paths end
    Raises InputError where the goal is not on the site, and NoPathError where the robot cannot stand there.
    """

    def __init__(self, planner: Planner, goal: Any, coordinates: str = "site"):
        """See `travjax.plan` for the arguments."""
        self.planner, self.goal = planner, endpoint("goal", goal, planner.costs, coordinates)
        if not standing(self.goal, planner.costs):
            raise cannot_stand(self.goal, self.goal, planner.costs)
        self._search, self._refused = self._searched(), planner.costs.refused

    @usual_flags()
    def _searched(self) -> Search:
        costs, lattice = self.planner.costs, self.planner.lattice
        search = Search(lattice.moves_back, lattice.headings, np.where(np.isfinite(costs.easiest), 0.0, np.inf))
        for state in standing(self.goal, costs):
            search.start(state)
        with costs.watched("cost to go", whole=True):
            search.run(costs, None)
        return search

    @property
    def by_heading(self) -> Float[np.ndarray, "rows cols h"]:
        """The cost from every place and heading, as of Motions; inf where there is no path."""
        return self._search.best.reshape(*self.planner.costs.shape, -1)

    @property
    def best(self) -> Float[np.ndarray, "rows cols"]:
        """The cost from every place, at its best heading; inf where there is no path."""
        return self.by_heading.min(axis=-1)

    @property
    def direction(self) -> Float[np.ndarray, "rows cols"]:
        """Where the cheapest path from every place leads: radians, anticlockwise from +y; NaN where there is none.

        It is where its first drive leads, after point turns, which may cost nothing.
        """
        lattice, moves = self.planner.lattice, self._search.moves
        heading = self.by_heading.argmin(axis=-1)
        first = np.arange(heading.size).reshape(heading.shape) * lattice.headings
        while True:
            arrived = self._search.arrived[first + heading].astype(int)
            arrived[arrived == NOWHERE] = -1
            turning = np.append(moves.motion, -1)[arrived] >= len(lattice.drives)
            if not turning.any():
                break
            heading = np.where(turning, arrived // moves.motion.shape[1], heading)
        backwards = np.append(moves.backwards, False)[arrived]
        return np.where(np.isfinite(self.best), (lattice.angles[heading] + np.pi * backwards) % (2 * np.pi), np.nan)

    def plan(self, start: Any, coordinates: str = "site") -> Plan:
        """Returns the cheapest path from a start to the goal; arguments and errors are those of `travjax.plan`."""
        planner = self.planner
        begin = endpoint("start", start, planner.costs, coordinates)
        planner.require_standing(begin)

        def find() -> Found:
            if self._refused != planner.costs.refused:
                self._search, self._refused = self._searched(), planner.costs.refused
            state = min(standing(begin, planner.costs), key=lambda state: self._search.best[state])
            cost = float(self._search.best[state])
            if not np.isfinite(cost):
                return planner.cheapest((begin, self.goal))  # which says why there is no path
            legs, first = [], state
            while (step := self._search.step_to(state)) is not None:
                legs.append(planner.leg(self._search, *step))
                state = step[0]
            return legs, cost, first

        return planner.checked((begin, self.goal), find)
