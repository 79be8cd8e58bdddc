"""What a step of the hazard field's training sees: labels of turned and mirrored maps, targets and corruption."""

from dataclasses import replace

import numpy as np
import pytest

from tests.commandline import FEW
from tests.conftest import SEEKUR_JR, SETUPS
from tests.field_runs import PRESET
from tests.small_training import GRID, HUSKY, SETUP, dataset
from travjax.config import InputError
from travjax.data.sensor_noise import CorruptionConfig
from travjax.estimators.map_samples import MapSamples, MapSource
from travjax.models.pose_stencil import stencil
from travjax.simulation.footprint import View, views_of
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import failures, simulate, unpacked

CLEAN = replace(PRESET, corruption=CorruptionConfig(0.0))
STEPS = range(12)


def data_of(preset=CLEAN, data=None, **training) -> MapSamples:
    return MapSamples(data or dataset(), replace(preset, training=replace(preset.training, **training)))


def shown(prepared) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Heights above the centre, the trajectories that are read, and their targets: margins and known."""
    (elevation, part), (margins, known) = prepared
    table = stencil(SETUP)
    arcs = [int(np.flatnonzero((table.nodes == nodes).all(axis=(1, 2))).item()) for nodes in part.nodes]
    assert (part.first_poses, part.second_arcs) == (table.first_poses, table.second_arcs)
    trajectories = np.concatenate([np.arange(len(FEW.radii)) + arc * len(FEW.radii) for arc in arcs])
    return np.asarray(elevation) * PRESET.elevation_scale, trajectories, np.asarray(margins), np.asarray(known)


def images_of(one: np.ndarray) -> list[np.ndarray]:
    """A map in all its eight positions."""
    turned = [np.rot90(one, count) for count in range(4)]
    return turned + [np.flip(image, 1) for image in turned]


def above_centre(one: np.ndarray) -> np.ndarray:
    return one - one[len(one) // 2, len(one) // 2]


# ---- Labels of a turned or mirrored map


@pytest.mark.parametrize("size", ["paper", "few"])
def test_labels_of_another_view_are_permuted_labels_of_the_map(size, maps):
    """Verified by labelling the turned and the mirrored map anew."""
    if size == "paper":
        setup = Setup(SEEKUR_JR)
        heights = np.stack([maps[name] for name in ("mountain_crater", "scattered_sharp", "holes")])
    else:
        setup = SETUP
        heights = dataset().heights[:8]
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    views = views_of(actions)
    assert len(views) == 4
    seen = np.stack([np.flip(heights, tuple(axis + 1 for axis in view.flipped)) for view in views])
    relabelled = simulate(seen.reshape(-1, *grid.shape), robot, actions, grid=grid)
    shape = (len(views), len(heights), len(actions))
    margins = np.asarray(relabelled.events()).reshape(*shape, 3)
    failed, known = np.asarray(failures(relabelled, robot)).reshape(*shape, 3), np.asarray(relabelled.known)
    known = known.reshape(shape)
    assert views[0] == View() and failed[0].any(axis=(0, 1)).all()
    for number, view in enumerate(views):
        order = view.trajectories(actions)
        np.testing.assert_array_equal(failed[number], failed[0][:, order])
        np.testing.assert_array_equal(known[number], known[0][:, order])
        np.testing.assert_allclose(margins[number], margins[0][:, order], atol=1e-5)
        assert not number or (failed[number] != failed[0]).any()


@pytest.mark.parametrize("name", ["paper", "odd number of turns", "unpaired radii", "arcs of different length"])
def test_the_trajectories_of_a_view_are_those_of_the_map_and_twice_turned_is_as_it_was(name):
    actions = SETUPS[name].actions
    for view in views_of(actions):
        order = view.trajectories(actions)
        np.testing.assert_array_equal(np.sort(order), np.arange(len(actions)))
        np.testing.assert_array_equal(order[order], np.arange(len(actions)))
        assert (order == np.arange(len(actions))).all() == (view == View())


# ---- A step


def test_targets_are_the_margins_of_the_map_that_is_seen():
    data, maps, limits = data_of(), dataset().maps_of("train")[:4], np.array(HUSKY.limits)
    for step in STEPS:
        seen, trajectories, margins, known = shown(data.prepared(maps, step))
        wanted = np.asarray(simulate(seen, HUSKY, FEW, grid=GRID).events())[:, trajectories] / limits
        assert known.all() and margins.shape == (4, 6, 3)
        np.testing.assert_allclose(margins, wanted, atol=1e-4)


def test_maps_are_seen_in_all_positions_and_uncorrupted_otherwise():
    data, maps = data_of(), dataset().maps_of("train")[:2]
    positions = set()
    for step in range(60):
        seen = shown(data.prepared(maps, step))[0]
        for one, index in zip(seen, maps, strict=True):
            images = [np.abs(above_centre(image) - one).max() for image in images_of(dataset().heights[index])]
            assert min(images) < 1e-5
            positions.add(int(np.argmin(images)))
    assert positions == set(range(8))


def test_targets_of_corrupted_maps_are_those_of_the_clean_ones():
    maps = dataset().maps_of("train")[:4]
    noisy = data_of(replace(PRESET, corruption=CorruptionConfig(1.0, 0.05, 0.3, 0.5)))
    for step in STEPS:
        seen, trajectories, *targets = shown(noisy.prepared(maps, step))
        clean, same, *wanted = shown(data_of().prepared(maps, step))
        assert (np.abs(seen - clean).max(axis=(1, 2)) > 1e-4).all() and np.isfinite(seen).all()
        np.testing.assert_array_equal(trajectories, same)
        for one, other in zip(targets, wanted, strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_share_of_the_maps_is_corrupted():
    data, maps = data_of(replace(PRESET, corruption=CorruptionConfig(0.3, 0.05))), dataset().maps_of("train")
    different = []
    for step in range(10):
        (seen, *_), (clean, *_) = shown(data.prepared(maps, step)), shown(data_of().prepared(maps, step))
        different.append((seen != clean).any(axis=(1, 2)))
    assert 0.15 < np.mean(different) < 0.45  # of 180


def test_a_step_is_the_same_each_time_and_unlike_another_step_or_seed():
    maps = dataset().maps_of("train")[:4]
    one, same, other, seeded = (
        shown(data_of(PRESET, seed=seed).prepared(maps, step)) for seed, step in ((0, 3), (0, 3), (0, 4), (1, 3))
    )
    for a, b in zip(one, same, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (one[0] != other[0]).any() and (one[0] != seeded[0]).any()
    arcs = {tuple(shown(data_of().prepared(maps[:1], step))[1]) for step in STEPS}
    assert len(arcs) > 3


def test_the_arcs_of_a_step_are_different_and_as_many_as_the_setup_says():
    maps = dataset().maps_of("train")[:1]
    for each, count in ((1, 1), (3, 1), (7, 2), (9, 3), (999, 6)):
        trajectories = shown(data_of(trajectories_per_map=each, failing_per_map=0).prepared(maps, 0))[1]
        assert len(np.unique(trajectories)) == len(trajectories) == 3 * count


def test_preparing_a_step_leaves_the_data_set_alone():
    before = dataset().heights.copy()
    data_of(replace(PRESET, corruption=CorruptionConfig(1.0, 0.05, 0.9))).prepared(dataset().maps_of("train"), 0)
    np.testing.assert_array_equal(dataset().heights, before)


def test_trajectories_on_unknown_ground_are_no_targets():
    heights = dataset().heights.copy()
    heights[:, 24:28, 10:20] = np.nan
    data, maps = (
        data_of(data=replace(dataset(), heights=heights), trajectories_per_map=999),
        dataset().maps_of("train")[:3],
    )
    positions = np.stack(images_of(heights[maps[0]]))
    masks, share = np.asarray(simulate(positions, HUSKY, FEW, grid=GRID).known), []
    for step in STEPS:
        seen, trajectories, margins, known = shown(data.prepared(maps, step))
        assert (known[0] == masks[:, trajectories]).all(axis=1).any()
        assert np.isfinite(seen).all() and (margins[~known] == 0).all() and (margins[known] > 0).any(axis=-1).all()
        share.append(known.mean())
    assert 0 < np.mean(share) < 1


# ---- Which maps


def test_batches_are_the_prepared_steps_of_an_epoch_from_any_of_them_on():
    data = data_of(PRESET)
    batches, (maps, weights) = list(data.batches(2, 1)), data.chosen(1)
    assert len(batches) == data.steps(2) == 5
    for number, batch in enumerate(batches):
        np.testing.assert_array_equal(batch.weight, weights[number])
        for one, other in zip(shown(batch[:2]), shown(data.prepared(maps[number], 5 + number)), strict=True):
            np.testing.assert_array_equal(one, other)
    later = list(data.batches(2, 1, 3))
    assert len(later) == 2
    np.testing.assert_array_equal(shown(later[0][:2])[0], shown(batches[3][:2])[0])


def test_the_samples_of_an_epoch_are_all_known_trajectories_of_the_training_maps():
    data = data_of()
    known = np.asarray(unpacked(dataset().labels[data.maps])[1])
    assert len(data.samples(2, 0)[0]) == known.sum() and set(data.samples(2, 0)[0]) <= set(data.maps)


def test_an_epoch_is_every_training_map_once_in_random_order():
    data, orders = data_of(), []
    for epoch in (0, 1, 0):
        maps, weights = data.chosen(epoch)
        assert data.steps(2) == len(maps) == 5 and np.shape(maps) == (5, 4)
        order, weight = np.concatenate(maps), np.concatenate(weights)
        assert weight.sum() == data.count(2, epoch) == 18 and set(weight) == {0, 1}
        np.testing.assert_array_equal(np.sort(order[weight > 0]), dataset().maps_of("train"))
        orders.append(order.tolist())
    assert orders[0] == orders[2] != orders[1]


@pytest.mark.parametrize(("most", "count"), [(1, 1), (40, 2), (18 * 4, 4), (10**6, 6)])
def test_validation_samples_are_all_known_trajectories_of_some_maps(most, count):
    data = data_of(validation_samples=most)
    maps, trajectories = data.validation
    assert len(np.unique(maps)) == count and set(maps) <= set(dataset().maps_of("validation"))
    known = np.asarray(unpacked(dataset().labels)[1])
    for index in np.unique(maps):
        np.testing.assert_array_equal(np.sort(trajectories[maps == index]), np.flatnonzero(known[index]))
    failed = data.failed(data.validation)
    assert failed.dtype == np.float32
    np.testing.assert_array_equal(failed, np.asarray(unpacked(dataset().labels)[0])[maps, trajectories])


@pytest.mark.parametrize(("split", "number"), [("train", 0), ("validation", 1)])
def test_a_data_set_without_maps_of_a_split_is_refused(split, number):
    other = replace(dataset(), split=np.where(dataset().split == number, 2, dataset().split).astype(np.uint8))
    with pytest.raises(InputError, match=f"^data set, {split} split = 0: must be at least one map") as raised:
        data_of(data=other)
    assert "\n" not in str(raised.value)


def test_the_summary_counts():
    assert data_of().summary() == "18 training maps; 36 validation samples"


def test_a_source_is_of_all_trajectories_and_of_maps_relative_to_their_centre():
    source = MapSource.from_maps(dataset().heights, SETUP, 0.5)
    assert source.stencil is stencil(SETUP)
    wanted = np.stack([above_centre(dataset().heights[index]) for index in (3, 1)]) / 0.5
    np.testing.assert_allclose(source.elevation(np.array([3, 1])), wanted, atol=1e-6)
