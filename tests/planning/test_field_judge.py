"""The hazard field as a judge: its probabilities are those of the network at the poses of a motion, place by place."""

from functools import partial

import numpy as np
import pytest

import travjax
from travjax.config import InputError
from travjax.data.sensor_noise import filled
from travjax.models.pose_stencil import nodes_at
from travjax.planning.field_judge import FieldJudge
from travjax.planning.judges import UNKNOWN
from travjax.planning.motions import Motions
from travjax.planning.planner import Planner
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.site.ground import ArrayGround
from travjax.site.kernel import Tile


@pytest.fixture(scope="module")
def predictor() -> travjax.Predictor:
    return travjax.Predictor.load()


def heights() -> np.ndarray:
    ground = np.asarray(travjax.generate_terrain("scattered_sharp", [3]))[0].copy()
    ground[:12, :9] = np.nan
    return ground


@pytest.fixture(scope="module")
def planner(predictor) -> Planner:
    judge = partial(FieldJudge, predictor=predictor, keep=True)
    return Planner(ArrayGround(heights()), headings=4, contact="nearest", motions=Motions(radius=0.5), judge=judge)


def test_probabilities_are_those_of_the_network_at_the_poses(planner, predictor):
    tile, setup = Tile(8, 8, 8), planner.setup
    factor, in_the_way = planner.costs.judge.motions(tile)
    judge, motions = planner.costs.judge, planner.lattice.all
    count = tile.edge * setup.step + 2 * judge._halo
    first = tile.row * setup.step - judge._halo
    ground = filled(planner.costs.ground.part(slice(first, first + count), slice(first, first + count))[None])
    elevation = (ground - ground[0, count // 2, count // 2]) / predictor.run.preset.elevation_scale
    channels = predictor.network.trunk(elevation, False)
    odd = count + 1 - count % 2
    window = Setup(setup.robot, ActionSpace(), Grid((odd - 1) * setup.spacing, setup.spacing))
    where = dict(zip((0, 5, 9, 13), ((0, 0), (3, 5), (7, 2), (4, 4)), strict=True))
    stencils = []
    for number, (row, col) in where.items():
        primitive = motions[number].primitive
        place = np.array([col, row]) * setup.step + judge._halo - (odd - 1) // 2
        poses = primitive.poses(setup.interval) + [*(place * setup.spacing), 0]
        nodes = nodes_at(poses, primitive.radii(setup.interval), window)
        stencils.append(nodes // odd * count + nodes % odd)
    hazard = np.asarray(predictor.network.at(channels, np.concatenate(stencils)))[:, 0, :3].astype(float)
    parts = np.split(hazard, np.cumsum([len(nodes) for nodes in stencils])[:-1])
    for (number, (row, col)), part in zip(where.items(), parts, strict=True):
        expected = 1 / (1 + np.exp(-np.logaddexp.reduce(part, axis=0)))
        largest, _ = judge._kept[tile]
        assert largest[number, row, col] == pytest.approx(expected.max(), abs=2e-5)
        if in_the_way[number, row, col] == 0:
            risk = planner.lattice.motions.risk
            assert factor[number, row, col] == pytest.approx(1 + risk * expected.max() ** 2, rel=1e-4)


def test_motions_over_unknown_ground_and_improbable_ones_are_impossible(planner):
    factor, in_the_way = planner.costs.judge.motions(Tile(0, 0, 8))
    assert (in_the_way[:, :2, :2] == UNKNOWN).all()
    assert np.array_equal(np.isinf(factor), in_the_way > 0)
    light, _ = planner.costs.judge.weighing(0.0).motions(Tile(0, 0, 8))
    assert set(np.unique(light)) <= {1.0, np.inf} and np.array_equal(np.isinf(light), np.isinf(factor))


def test_a_path_by_the_field_is_checked_but_not_refused(planner):
    found = planner.plan((2.0, 3.0), (6.5, 6.0))
    assert found.checks["motions refused before"] == 0 and found.checks["poses on unknown ground"] == 0
    assert len(found.path.z) == found.checks["poses simulated"] > 50


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(contact="tyre"), "contact = 'tyre': must be nearest, which the estimator was trained for"),
        (dict(robot="leo_rover"), "robot = 'Leo Rover': must be Seekur Jr"),
    ],
)
def test_an_estimator_judges_what_it_was_trained_for(predictor, changes, message):
    settings = dict(contact="nearest", headings=4, motions=Motions(radius=0.5)) | changes
    with pytest.raises(InputError, match=message):
        Planner(ArrayGround(heights()), judge=partial(FieldJudge, predictor=predictor), **settings)
    coarse = ArrayGround(np.zeros((40, 40), np.float32), 0.0, 0.125)
    with pytest.raises(InputError, match="spacing = 0.125: must be 0.0625 m, as in training"):
        Planner(coarse, headings=4, contact="nearest", judge=partial(FieldJudge, predictor=predictor))
