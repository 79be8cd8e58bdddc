"""What sensors do to maps: statistics, interpolation on planes, filling against a search of all nodes."""

import numpy as np
import pytest

from travjax.config import InputError
from travjax.data.sensor_noise import CorruptionConfig, corrupted, filled, median, noisy, smoothed, thinned, upsampled

RNG = np.random.default_rng(0)
MAPS = RNG.normal(0, 0.3, (3, 21, 21)).astype(np.float32)


def test_noise_has_its_deviation_and_is_independent():
    noise = noisy(np.zeros((40, 65, 65), np.float32), 0.02, np.random.default_rng(1))
    assert noise.dtype == np.float32 and noise.std() == pytest.approx(0.02, rel=0.01) and abs(noise.mean()) < 2e-4
    assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 1e-5


def test_a_share_of_the_nodes_is_missing():
    known = thinned(np.tile(MAPS, (40, 1, 1)), 0.2, np.random.default_rng(1))
    assert np.isnan(known).mean() == pytest.approx(0.2, abs=0.01)
    np.testing.assert_array_equal(known[~np.isnan(known)], np.tile(MAPS, (40, 1, 1))[~np.isnan(known)])


def test_missing_nodes_get_the_height_of_the_nearest_known_one():
    holes = thinned(MAPS, 0.6, np.random.default_rng(2))
    for one, whole in zip(holes, filled(holes), strict=True):
        known = np.argwhere(~np.isnan(one))
        for row, col in np.ndindex(one.shape):
            far = np.hypot(*(known - (row, col)).T)
            nearest = {float(one[tuple(place)]) for place in known[far <= far.min() + 1e-9]}
            assert float(whole[row, col]) in nearest


def test_a_map_without_a_known_node_is_flat():
    assert not filled(np.full((1, 5, 5), np.nan, np.float32)).any()


def test_planes_come_back_from_every_second_node():
    rows, cols = np.mgrid[:9, :9].astype(np.float32)
    plane = (0.3 * rows - 0.2 * cols + 1)[None]
    np.testing.assert_allclose(upsampled(plane), plane, atol=1e-6)


def test_only_every_second_node_is_seen():
    changed = MAPS.copy()
    changed[:, 1::2] += 7
    changed[:, :, 1::2] += 5
    np.testing.assert_array_equal(upsampled(changed), upsampled(MAPS))
    np.testing.assert_array_equal(upsampled(MAPS)[:, ::2, ::2], MAPS[:, ::2, ::2])
    np.testing.assert_allclose(upsampled(MAPS)[:, 1, 1], MAPS[:, :3:2, :3:2].mean(axis=(1, 2)), atol=1e-6)


def test_filters_leave_planes_inside_and_maps_apart():
    rows, cols = np.mgrid[:21, :21].astype(np.float32)
    plane = 0.3 * rows - 0.2 * cols
    for smooth in (lambda maps: smoothed(maps, 1.0), median):
        both = smooth(np.stack([plane, MAPS[0]]))
        np.testing.assert_allclose(both[0, 6:-6, 6:-6], plane[6:-6, 6:-6], atol=1e-5)
        np.testing.assert_allclose(both[1], smooth(MAPS[:1])[0], atol=1e-6)
        assert both[1].std() < MAPS[0].std()


def test_corruption_follows_from_the_generator_and_leaves_its_input():
    config, before = CorruptionConfig(0.7, 0.05, 0.3, 0.5), MAPS.copy()
    many = np.tile(MAPS, (10, 1, 1))
    one, same, other = (corrupted(many, config, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() and np.isfinite(one).all() and one.dtype == np.float32
    untouched = (one == many).all(axis=(1, 2)).mean()
    assert 0.1 < untouched < 0.6
    np.testing.assert_array_equal(MAPS, before)


def test_without_a_share_maps_stay_as_they_are():
    np.testing.assert_array_equal(corrupted(MAPS, CorruptionConfig(0.0), np.random.default_rng(0)), MAPS)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("probability", 1.5),
        ("probability", -0.1),
        ("noise", -1),
        ("missing", 0.95),
        ("coarse", 2),
        ("probability", "x"),
    ],
)
def test_what_cannot_be_is_refused(name, value):
    with pytest.raises(InputError, match=f"{name} = "):
        CorruptionConfig(**{name: value})
