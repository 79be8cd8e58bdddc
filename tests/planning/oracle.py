"""A planner by exhaustion, which the planner's tests compare with: plain Python over the sequential simulators.

Every edge is simulated pose by pose on the whole site, as travjax.traversal.reference and tyre_reference do it, and
priced as the docstring of `Motions` says. Only the motions themselves and their poses are those of the planner.
"""

import heapq
import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from travjax.data.sensor_noise import filled
from travjax.planning.motions import Motion, MotionLattice
from travjax.planning.path import Leg, Path
from travjax.planning.planner import Plan, Planner
from travjax.simulation.robot import Robot
from travjax.site.ground import Site
from travjax.site.kernel import SiteSetup
from travjax.site.primitives import PointTurn
from travjax.traversal import reference, tyre_reference

State = tuple[int, int, int]
"""Row and column of a place, and the number of a heading."""


class Simulated:
    """Poses on a whole site, one after the other; ground: heights [rows, cols] in metres, NaN where unknown."""

    def __init__(self, ground: np.ndarray, robot: Robot, spacing: float, contact: str):
        self.robot, self.spacing, self.contact = robot, spacing, contact
        rows, cols = ground.shape
        half = max(rows, cols) // 2 + math.ceil(2 * (robot.overall_length + robot.overall_width) / spacing)
        self.heights = np.full((2 * half + 1,) * 2, np.nan)
        south, west = half - rows // 2, half - cols // 2
        self.heights[south : south + rows, west : west + cols] = np.asarray(ground, np.float32)
        self.middle = np.array([cols // 2, rows // 2]) * spacing
        self._tyre = tyre_reference.ground_of(self.heights, robot, spacing)
        self._standing: dict[tuple[float, ...], reference.PoseState | tyre_reference.PoseState] = {}

    def state(self, x: float, y: float, heading: float):
        """Returns how the robot stands at a pose, from the south-west node."""
        key = round(x, 8), round(y, 8), round(heading % (2 * math.pi), 8)
        if key not in self._standing:
            at = x - self.middle[0], y - self.middle[1], heading
            self._standing[key] = (
                tyre_reference.pose_state(self._tyre, self.robot, *at, self.spacing)
                if self.contact == "tyre"
                else reference.pose_state(self.heights, self.robot, *at, self.spacing)
            )
        return self._standing[key]

    def margins(self, poses: np.ndarray) -> list[dict[str, float] | None]:
        """Returns the margins of each of some poses that follow each other; None where the ground is unknown."""
        seen, before = list[dict[str, float] | None](), None
        for pose in poses.tolist():
            now = self.state(*pose)
            if not now.known:
                seen.append(None)
                before = None
                continue
            if self.contact == "tyre":
                step = now.step
            else:
                step = 0.0 if before is None else max(abs(a - b) for a, b in zip(now.contacts, before, strict=True))
                before = now.contacts
            roll = abs(math.atan(now.roll_slope))
            seen.append({"step": step, "obstacle": now.clearance, "tilt": now.tilt, "roll": roll})
        return seen


class Exhaustive:
    """The cheapest paths on the site of a planner, found by Dijkstra's algorithm without a bound."""

    def __init__(self, planner: Planner):
        setup, ground = planner.setup, planner.costs.ground
        self.lattice: MotionLattice = planner.lattice
        self.robot, self.interval, self.stride = setup.robot, setup.interval, setup.stride
        self.shape = setup.lattice(ground.shape)
        self.unknown_cost = planner.unknown_cost
        rows, cols = ground.shape
        heights = ground.part(slice(0, rows), slice(0, cols))
        self.simulated = Simulated(heights, setup.robot, setup.spacing, setup.contact)
        assumed = filled(heights[None])[0]  # unknown ground is as high as the nearest known
        self.assumed = Simulated(assumed, setup.robot, setup.spacing, setup.contact)
        self._factors: dict[tuple[int, int, int], float] = {}

    def cost(self, number: int, row: int, col: int) -> float:
        """Returns what a motion costs from a place, by the docstring of Motions; inf where the robot fails."""
        motion, motions = self.lattice.all[number], self.lattice.motions
        key = number, row, col
        if key not in self._factors:
            self._factors[key] = self._factor(motion, row, col)
        return self._factors[key] * (length_of(motion) + motions.turning * turned_by(motion))

    def _factor(self, motion: Motion, row: int, col: int) -> float:
        """Returns 1 + risk * r^2, that of unknown ground, or inf."""
        risk, largest = self.lattice.motions.risk, 0.0
        turning, unknown = isinstance(motion.primitive, PointTurn), False
        poses = motion.primitive.poses(self.interval) + [col * self.stride, row * self.stride, 0]
        for margins in self.simulated.margins(poses):
            if margins is None:
                unknown = True
                if self.unknown_cost is None:
                    return math.inf
                continue
            largest = max(largest, self._share(margins, turning))
            if largest > 1:
                return math.inf
        if not unknown:
            return 1 + risk * largest**2
        then = self.assumed.margins(poses)
        possible = all(margins is not None and self._share(margins, turning) <= 1 for margins in then)
        return self.unknown_cost * (1 + risk) if possible else math.inf

    def _share(self, margins: dict[str, float], turning: bool) -> float:
        events = zip(self.robot.events, self.robot.limits, strict=True)
        return max(margins[event.name] / limit for event, limit in events if not (turning and event.name == "step"))

    @cached_property
    def steps(self) -> list[list[tuple[int, int, int, int, int, int, float]]]:
        """From each heading: rows and columns to go, heading of the end, motion, rows and columns to where that
        begins, factor of its cost.
        """
        steps: list[list[tuple[int, int, int, int, int, int, float]]] = [[] for _ in range(self.lattice.headings)]
        for number, motion in enumerate(self.lattice.all):
            steps[motion.heading].append((motion.rows, motion.cols, motion.end, number, 0, 0, 1.0))
            turning = isinstance(motion.primitive, PointTurn)
            if turning or self.lattice.motions.reverse:
                away = -motion.rows, -motion.cols
                factor = 1.0 if turning else self.lattice.motions.reversing
                steps[motion.end].append((*away, motion.heading, number, *away, factor))
        return steps

    def edges(self, state: State) -> Iterable[tuple[State, float]]:
        """Yields where the robot can go from a state, and the cost."""
        row, col, heading = state
        for rows, cols, end, number, from_rows, from_cols, factor in self.steps[heading]:
            to_row, to_col = row + rows, col + cols
            if 0 <= to_row < self.shape[0] and 0 <= to_col < self.shape[1]:
                cost = factor * self.cost(number, row + from_rows, col + from_cols)
                if cost < math.inf:
                    yield (to_row, to_col, end), cost

    def stands(self, row: int, col: int, heading: int) -> bool:
        """Whether the robot can stand in a state."""
        margins = self.simulated.margins(
            np.array([[col * self.stride, row * self.stride, self.lattice.angles[heading]]])
        )[0]
        if margins is None:
            return self.unknown_cost is not None
        fails = zip(self.robot.events, self.robot.limits, strict=True)
        return not any(event.name != "step" and margins[event.name] > limit for event, limit in fails)

    def states(self, row: int, col: int, heading: int | None = None) -> list[State]:
        """Returns the states at a place in which the robot can stand, in one heading or all."""
        headings = range(self.lattice.headings) if heading is None else [heading]
        return [(row, col, one) for one in headings if self.stands(row, col, one)]

    def cheapest(self, points: Sequence[tuple[int, int, int | None]]) -> float:
        """Returns the cost of the cheapest path past places, in a heading or any; inf where there is none."""
        costs = dict.fromkeys(self.states(*points[0]), 0.0)
        for point in points[1:]:
            costs = self._reached(costs, set(self.states(*point)), every=point is not points[-1])
        return min(costs.values(), default=math.inf)

    def _reached(self, starts: dict[State, float], goals: set[State], every: bool) -> dict[State, float]:
        """Returns what the cheapest path costs to each goal that can be reached, or to one; starts: what theirs is."""
        best, done, reached = dict(starts), set[State](), dict[State, float]()
        heap = [(cost, state) for state, cost in starts.items()]
        heapq.heapify(heap)
        while heap and len(reached) < (len(goals) if every else 1):
            cost, state = heapq.heappop(heap)
            if state in done:
                continue
            done.add(state)
            if state in goals:
                reached[state] = cost
            for end, more in self.edges(state):
                if cost + more < best.get(end, math.inf):
                    best[end] = cost + more
                    heapq.heappush(heap, (cost + more, end))
        return reached


def length_of(motion: Motion) -> float:
    """Returns the metres that a motion drives."""
    return 0.0 if isinstance(motion.primitive, PointTurn) else sum(length for _, length in motion.primitive.arcs)


def turned_by(motion: Motion) -> float:
    """Returns the radians that a motion turns by, to the left and right added up."""
    if isinstance(motion.primitive, PointTurn):
        return abs(motion.primitive.angle)
    return sum(length / abs(radius) for radius, length in motion.primitive.arcs)


def check_plan(plan: Plan, planner: Planner) -> dict[str, float]:
    """Checks where a plan begins, passes and ends, that no pose exceeds a limit, and what `check_path` does.

    Returns the largest errors, as of `check_path`.
    """
    poses = plan.path.pose - [*planner.costs.ground.origin, 0.0]
    origin = planner.costs.ground.origin
    for row, point in ((0, plan.points[0]), (-1, plan.points[-1])):
        heading = point.heading
        assert heading is None or angle(poses[row, 2] - planner.lattice.angles[heading]) < 1e-9
    places = np.array([(point.x - origin[0], point.y - origin[1]) for point in plan.points])
    away = np.hypot(*(poses[:, None, :2] - places).transpose(2, 0, 1))
    assert away[0, 0] < 1e-9 and away[-1, -1] < 1e-9 and away.min(axis=0).max() < 1e-9
    assert not plan.path.exceeds.any()
    assert plan.path.known.all() or planner.unknown_cost is not None
    return check_path(plan.path, plan.legs, planner.costs.ground, planner.setup, planner.lattice.headings)


def check_path(path: Path, legs: Sequence[Leg], ground: Site, setup: SiteSetup, headings: int) -> dict[str, float]:
    """Checks that a path is drivable, has enough poses, and is what the sequential simulators say of the whole site.

    Returns the largest errors: of joins (metres, radians), of drives against arcs between their poses (metres), and of
    what was simulated (metres, radians); and the largest margin as a share of its limit.
    """
    errors = {"join": 0.0, "join angle": 0.0, "arc": 0.0, "simulated": 0.0, "share": 0.0}
    poses = path.pose - [*ground.origin, 0.0]
    parts = [leg.poses(setup.interval, setup.stride) for leg in legs]
    for before, after in pairwise(parts):
        errors["join"] = max(errors["join"], float(np.hypot(*(before[-1] - after[0])[:2])))
        errors["join angle"] = max(errors["join angle"], angle(before[-1, 2] - after[0, 2]))
    if parts:
        of_legs = np.concatenate([parts[0][:1], *(part[1:] for part in parts)])
        np.testing.assert_allclose(poses[:, :2], of_legs[:, :2], atol=1e-9, rtol=1e-12)
        assert max(map(angle, poses[:, 2] - of_legs[:, 2])) < 1e-9
        names = [leg.name for leg, part in zip(legs, parts, strict=True) for _ in part[1:]]
        assert path.motion == (names[0], *names)

    turning = np.array([name.startswith("turn") for name in path.motion])
    far = [0.0]
    for (x, y, was), (to_x, to_y, now), motion in zip(poses, poses[1:], path.motion[1:], strict=False):
        turned, chord = math.remainder(now - was, 2 * math.pi), math.hypot(to_x - x, to_y - y)
        if motion.startswith("turn"):
            assert 0 < abs(turned) <= 2 * math.pi / headings / 4 + 1e-9 and chord < 1e-9
            assert (turned > 0) == (motion == "turn_left")
            far.append(far[-1])
            continue
        ahead = was + turned / 2  # the chord of an arc points half way between the headings at its ends
        along = chord * (-1 if motion.startswith("reverse") else 1)
        miss = to_x - x + math.sin(ahead) * along, to_y - y - math.cos(ahead) * along
        errors["arc"] = max(errors["arc"], math.hypot(*miss))
        far.append(far[-1] + chord / float(np.sinc(turned / 2 / math.pi)))
        assert far[-1] - far[-2] <= setup.interval + 1e-9
    np.testing.assert_allclose(path.distance, far, atol=1e-9)

    rows, cols = ground.shape
    whole = Simulated(ground.part(slice(0, rows), slice(0, cols)), setup.robot, setup.spacing, setup.contact)
    limits = dict(zip(setup.robot.event_names, setup.robot.limits, strict=True))
    for row, margins in enumerate(whole.margins(poses)):
        seen = [path.step[row], path.obstacle[row], path.tilt[row], path.z[row]]
        assert path.known[row] == (margins is not None)
        if margins is None:
            assert np.isnan(seen).all() and not path.exceeds[row]
            continue
        reached = margins["step"]
        if turning[row] or row == 0:
            margins["step"] = 0.0
        elif setup.contact == "nearest" and not path.known[row - 1]:  # a change from what is unknown, at least in part
            margins["step"] = seen[0] = 0.0
        wanted = [margins["step"], margins["obstacle"], margins["tilt"]]
        wanted.append(whole.state(*poses[row]).centre + ground.height_offset)
        errors["simulated"] = max(errors["simulated"], float(np.abs(np.subtract(seen, wanted)).max()))
        if setup.contact == "tyre" and row + 1 < len(poses) and not turning[row + 1]:
            margins["step"] = reached  # a drive begins here, on what its tyres reach
        share = max(margins[name] / limit for name, limit in limits.items())
        errors["share"] = max(errors["share"], share)
        assert path.exceeds[row] == (share > 1 + 1e-6)
    assert errors["join"] < 1e-9 and errors["join angle"] < 1e-9, errors  # a millimetre and a tenth of a degree may be
    assert errors["arc"] < 1e-9 and errors["simulated"] < 1e-9, errors
    return errors


def angle(radians: float) -> float:
    """Returns the size of an angle whatever its whole turns."""
    return abs(math.remainder(float(radians), 2 * math.pi))
