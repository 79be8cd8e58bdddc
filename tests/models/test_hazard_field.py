"""The hazard field: its read-out against a float64 loop over the poses, its head in NumPy, and batches."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.commandline import FEW
from tests.conftest import SEEKUR_JR
from tests.field_runs import CONFIG, estimator, forward, random_variables
from tests.small_training import SETUP, dataset
from travjax.config import InputError
from travjax.estimators.map_samples import MapSource, relative
from travjax.models.hazard_field import FieldConfig, HazardField, create, read_out
from travjax.models.pose_stencil import Stencil, nodes_at, stencil
from travjax.models.variables import merge_model, split_model
from travjax.simulation.actions import ActionSpace
from travjax.simulation.setup import Setup


@functools.partial(jax.jit, static_argnums=0)
def channels_of(graph, variables, elevation):
    return merge_model(graph, variables).trunk(elevation, False)


def trunk(field: HazardField, elevation):
    """The channels at all nodes."""
    return channels_of(*split_model(field), elevation)


def test_the_read_out_is_a_loop_over_the_poses_of_each_trajectory():
    table, actions, rng = stencil(Setup(SEEKUR_JR)), ActionSpace(), np.random.default_rng(0)
    arcs, poses = table.nodes.shape[:2]
    hazard = rng.normal(-3, 2, (arcs, poses, 2, 6)).astype(np.float32)
    logits, margins = map(np.asarray, read_out(jnp.asarray(hazard), table))
    assert logits.shape == margins.shape == (2, len(actions), 3)
    along = (poses - table.first_poses) // table.second_arcs
    for trajectory in rng.choice(len(actions), 200, replace=False):
        arc, second = divmod(int(trajectory), table.second_arcs)
        start = table.first_poses + second * along
        own = [*range(table.first_poses), *range(start, start + along)]
        assert len(own) == 57 == len(actions.poses(trajectory))
        for one in range(2):
            for event in range(3):
                of_poses = [float(hazard[arc, pose, one, event]) for pose in own]
                smooth = math.log(math.fsum(math.exp(value) for value in of_poses))
                assert logits[one, trajectory, event] == pytest.approx(smooth, abs=1e-4)
                largest = max(float(hazard[arc, pose, one, 3 + event]) for pose in own)
                assert margins[one, trajectory, event] == pytest.approx(largest, abs=1e-4)


def test_a_trajectory_is_read_at_its_own_poses_on_the_map():
    """The whole network against the channels of its U-Net, read by hand at the poses of `actions.poses`."""
    made, heights = estimator(), dataset().heights[:2]
    source = MapSource.from_maps(heights, SETUP, 0.1)
    elevation = source.elevation(np.arange(2))
    logits, margins = map(np.asarray, forward(made, elevation, source.stencil))
    channels = np.asarray(trunk(made, elevation), np.float64).reshape(2, -1, CONFIG.channels)
    heads = made.heads
    exact = lambda layer: [np.asarray(v[...], np.float64) for v in (layer.kernel, layer.bias)]
    first, bias = np.asarray(heads.first.kernel[...], np.float64), np.asarray(heads.bias[...], np.float64)
    second, hazard = exact(heads.second), exact(heads.hazard)
    for trajectory in range(len(FEW)):
        _, one, two = FEW.split(trajectory)
        poses, own = FEW.poses(trajectory), len(FEW.first_stations())
        radius = np.where(np.arange(len(poses)) < own, FEW.radii[one], FEW.radii[two])
        nodes = nodes_at(poses, radius, SETUP)
        for index in range(2):
            ground = channels[index][nodes]
            mean = ground.mean(axis=1, keepdims=True)
            places = np.concatenate([ground - mean, mean], axis=1).reshape(len(poses), -1)
            hidden = np.maximum(places @ first + bias, 0)
            found = np.maximum(hidden @ second[0] + second[1], 0) @ hazard[0] + hazard[1]
            smooth = np.log(np.exp(found[:, :3]).sum(axis=0))
            np.testing.assert_allclose(logits[index, trajectory], smooth, atol=1e-4)
            np.testing.assert_allclose(margins[index, trajectory], found[:, 3:].max(axis=0), atol=1e-4)


def test_a_map_is_seen_the_same_in_any_batch():
    source = MapSource.from_maps(dataset().heights, SETUP, 0.1)
    together = forward(estimator(), source.elevation(np.arange(5)), source.stencil)
    for index in (0, 3):
        alone = forward(estimator(), source.elevation(np.array([index])), source.stencil)
        for part, whole in zip(alone, together, strict=True):
            np.testing.assert_allclose(part[0], whole[index], atol=1e-5)


def test_the_height_of_the_map_plays_no_part():
    source, raised = (MapSource.from_maps(dataset().heights[:1] + up, SETUP, 0.1) for up in (0, 64))
    low, high = (forward(estimator(), one.elevation(np.array([0])), one.stencil)[0] for one in (source, raised))
    np.testing.assert_allclose(low, high, atol=1e-3)


def test_trajectories_of_a_few_first_arcs_are_those_of_all():
    source = MapSource.from_maps(dataset().heights[:1], SETUP, 0.1)
    table, elevation = source.stencil, source.elevation(np.array([0]))
    whole = forward(estimator(), elevation, table)[0].reshape(-1, table.second_arcs, 3)
    some = np.array([1, 4])
    part = forward(estimator(), elevation, Stencil(table.nodes[some], table.first_poses, table.second_arcs))[0]
    np.testing.assert_allclose(part.reshape(whole[some].shape), whole[some], atol=1e-5)


def test_an_unknown_node_is_seen_as_the_nearest_known_one():
    heights = dataset().heights[:1].copy()
    heights[0, 5, 7] = np.nan
    seen = MapSource.from_maps(heights, SETUP, 0.1).heights
    assert np.isfinite(seen).all() and seen[0, 5, 7] in heights[0, 4:7, 6:9]


@pytest.mark.parametrize("nodes", [32, 33, 34, 35])
def test_maps_may_have_any_number_of_nodes(nodes):
    elevation = np.random.default_rng(0).normal(size=(1, nodes, nodes)).astype(np.float32)
    channels = trunk(estimator(), elevation)
    assert channels.shape == (1, nodes, nodes, CONFIG.channels)
    np.testing.assert_array_equal(channels[..., -1], elevation)


def test_gradients_reach_every_parameter():
    graph, variables = random_variables()
    source = MapSource.from_maps(dataset().heights[:3], SETUP, 0.1)
    elevation = source.elevation(np.arange(3))
    weights = np.random.default_rng(0).normal(size=(2, 3, len(FEW), 3)).astype(np.float32)

    def total(parameters):
        made = merge_model(graph, variables | parameters)
        return sum(
            (part * w).sum() for part, w in zip(made(elevation, source.stencil, train=True), weights, strict=True)
        )

    gradients = jax.jit(jax.grad(total))({name: variables[name] for name in ("trunk", "heads")})
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0, path


def test_activations_may_be_bfloat16():
    config = FieldConfig(stem=4, widths=(4, 8), channels=3, hidden=8, dtype="bfloat16")
    source = MapSource.from_maps(dataset().heights[:1], SETUP, 0.1)
    found = [forward(create(c), source.elevation(np.array([0])), source.stencil)[0] for c in (config, CONFIG)]
    assert found[0].dtype == jnp.float32
    np.testing.assert_allclose(*found, atol=0.2)
    assert (np.asarray(found[0]) != np.asarray(found[1])).any()


def test_heights_are_relative_to_the_centre():
    heights = np.arange(18.0).reshape(2, 3, 3)
    np.testing.assert_array_equal(relative(heights, 2.0)[1], (np.arange(9.0).reshape(3, 3) - 4) / 2)


@pytest.mark.parametrize(
    ("name", "value"),
    [("widths", ()), ("widths", (4, 0)), ("channels", 1), ("hidden", 0), ("stem", 2.5), ("margin_weight", -1)]
    + [("epsilon", 0), ("momentum", 2), ("dtype", "float16"), ("widths", [4, 8])],
)
def test_what_cannot_be_is_refused(name, value):
    with pytest.raises(InputError, match=f"{name} = "):
        FieldConfig(**{name: value})
