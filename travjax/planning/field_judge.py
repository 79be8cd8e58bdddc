"""A judge of motions that asks the hazard field: probabilities of failure instead of margins.

The field reads a window around a tile of places once. A motion's probability is that of an arc of the action space:
its logit is the log-sum-exp of those of its poses.
"""

import copy
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from travjax.config import require
from travjax.data.sensor_noise import filled
from travjax.jax_flags import usual_flags
from travjax.models.pose_stencil import nodes_at
from travjax.models.variables import Variables, merge_model, split_model
from travjax.planning.judges import UNKNOWN, Judged, MarginJudge
from travjax.planning.motions import MotionLattice
from travjax.runs.predictor import Predictor
from travjax.simulation.actions import ActionSpace
from travjax.simulation.contact import Contact
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.site.ground import Site
from travjax.site.kernel import SiteSetup, Tile
from travjax.site.primitives import all_poses

AROUND = 2.0
"""Metres of ground that the network sees around what the motions of a tile touch."""


class FieldJudge:
    """Judges by the hazard field: motions more probable to fail than a threshold are impossible.

    The cost of the others grows with the probability p of their most probable event, by 1 + risk * p^2. Which ground is
    known is as for the margins. Motions do not lead over unknown ground.
    """

    unknown_allowed = False
    title = "hazard field"
    final = False  # a map may be noisy, and the sequential simulators take noise for ground

    def __init__(
        self,
        ground: Site,
        setup: SiteSetup,
        lattice: MotionLattice,
        predictor: Predictor,
        threshold: float = 0.5,
        keep: bool = False,
    ):
        """
        setup: robot, spacing, stride and contact model, which must be those that the predictor was trained for
        keep:  whether to keep what the field says of each tile, for judges made by `weighing`
        Raises InputError where they are others, and for an estimator that is not a hazard field.
        """
        run = predictor.run
        require(run.kind.reads_whole_maps, "estimator", run.preset.model, "field")
        predictor.require_trained_for(setup.robot, contact=setup.contact)
        trained = run.grid.spacing
        require(abs(setup.spacing / trained - 1) < 1e-6, "spacing", setup.spacing, f"{trained:g} m, as in training")
        require(0 < threshold < 1, "threshold", threshold, "a probability above 0 and below 1")
        self._ground, self._setup, self._threshold = ground, setup, threshold
        self._risk = lattice.motions.risk
        self._kept: dict[Tile, tuple[np.ndarray, np.ndarray]] | None = {} if keep else None
        self._known = MarginJudge(ground, setup, lattice)
        self._graph, self._variables = split_model(predictor.network)
        self._scale = np.float32(run.preset.elevation_scale)
        primitives = tuple(motion.primitive for motion in lattice.all)
        poses = all_poses(primitives, setup.interval)
        longest = poses.shape[1]
        radii = [primitive.radii(setup.interval) for primitive in primitives]
        self._real = np.stack([np.arange(longest) < len(one) for one in radii])
        padded = np.stack([np.pad(one, (0, longest - len(one)), mode="edge") for one in radii])
        half = math.ceil((np.abs(poses[..., :2]).max() + setup.robot.overall_length) / setup.spacing)
        grid = Grid(2 * half * setup.spacing, setup.spacing)
        around = Setup(setup.robot, ActionSpace(interval=setup.interval), grid, Contact.from_model(setup.contact))
        row, col = np.divmod(nodes_at(poses, padded, around), grid.nodes)
        self._offsets = np.stack([row - half, col - half])
        self._halo = half + math.ceil(AROUND / setup.spacing)

    def weighing(self, risk: float) -> "FieldJudge":
        """Returns a judge for which the probability has another weight in the cost."""
        other = copy.copy(self)
        other._risk = risk
        return other

    def motions(self, tile: Tile) -> Judged:
        """Judges the motions from the places of a tile."""
        if self._kept is None:
            largest, worst = self._probabilities(tile)
        else:
            if tile not in self._kept:
                self._kept[tile] = self._probabilities(tile)
            largest, worst = self._kept[tile]
        unknown = self._known.motions(tile)[1] == UNKNOWN
        in_the_way = np.where(unknown, UNKNOWN, np.where(largest > self._threshold, worst, 0)).astype(np.uint8)
        factor = np.where(in_the_way > 0, np.inf, 1 + self._risk * largest**2)
        return factor.astype(np.float32), in_the_way

    @usual_flags()
    def _probabilities(self, tile: Tile) -> tuple[np.ndarray, np.ndarray]:
        """Returns the probability of the most probable event of each motion, and the number of that event."""
        step, halo = self._setup.step, self._halo
        count = tile.edge * step + 2 * halo
        south, west = tile.row * step - halo, tile.col * step - halo
        heights = self._ground.part(slice(south, south + count), slice(west, west + count))
        elevation = filled(heights[None])
        centre = elevation[:, count // 2, count // 2, None, None]
        offsets = self._offsets[0] * count + self._offsets[1]
        places = halo + step * np.arange(tile.edge)
        first = (places[:, None] * count + places).ravel()
        network = self._graph, self._variables
        found = _probabilities(*network, (elevation - centre) / self._scale, offsets, self._real, first)
        probability = np.asarray(found).reshape(*found.shape[:2], tile.edge, tile.edge)
        return probability.max(axis=1), probability.argmax(axis=1) + 1

    def standing(self) -> Judged:
        """Judges that the robot can stand on all ground that is known: the field knows drives."""
        in_the_way = np.where(self._known.standing()[1] == UNKNOWN, UNKNOWN, 0).astype(np.uint8)
        return np.where(in_the_way > 0, np.inf, 1).astype(np.float32), in_the_way


@partial(jax.jit, static_argnames="graph")
def _probabilities(graph: nnx.GraphDef, variables: Variables, elevation, offsets, real, first) -> jax.Array:
    """Returns the probability of each event for motions from places: [motions, events, places].

    elevation: [1, n, n]; offsets: [motions, poses, s] of stencils' nodes from a place; real: [motions, poses] False for
    poses that only make motions equally long; first: [places] nodes
    """
    network = merge_model(graph, variables)
    channels = network.trunk(elevation, False)[0]
    channels = channels.reshape(-1, channels.shape[-1])

    def of_motion(motion):
        nodes, counts = motion
        ground = channels.at[nodes[..., None] + first].get(mode="promise_in_bounds")
        hazard = network.heads(ground)
        logits = jnp.where(counts[:, None, None], hazard[..., : hazard.shape[-1] // 2], -jnp.inf)
        return jax.nn.sigmoid(jax.nn.logsumexp(logits, axis=0)).T

    return jax.lax.map(of_motion, (offsets, real))
