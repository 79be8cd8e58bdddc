"""Heights as callers hand them over: every public function takes the same arrays, and refuses the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from travjax.config import InputError
from travjax.models.input_images import render_inputs
from travjax.runs.predictor import predict
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import MARKERS, Grid
from travjax.simulation.heights import as_maps
from travjax.terrain.styles import elevation, generate_terrain, sample_params
from travjax.traversal.traverse import label, simulate

GRID = Grid(4, 0.125)
ACTIONS = ActionSpace(turns=2, arc_lengths=(0.6, 0.5), radii=(float("inf"),), interval=0.1)
FUNCTIONS = {
    "simulate": lambda heights, grid=GRID: simulate(heights, "husky_a200", ACTIONS, grid=grid),
    "label": lambda heights, grid=GRID: label(heights, "husky_a200", ACTIONS, grid=grid),
    "render_inputs": lambda heights, grid=GRID: render_inputs(heights, 0, 1, "husky_a200", ACTIONS, grid=grid),
}


@pytest.fixture(params=FUNCTIONS)
def function(request):
    return FUNCTIONS[request.param]


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    """A map at 2000 m with a corner of unknown nodes, float64."""
    z = 2000 + 0.05 * np.random.default_rng(0).standard_normal(GRID.shape)
    z[28:, 28:] = np.nan
    return z


def masked(ground: np.ndarray):
    """As rasterio reads it: what lies under the mask is a number."""
    return np.ma.masked_array(np.where(np.isnan(ground), -9999.0, ground), np.isnan(ground))


def equal(one, other) -> None:
    for array, same in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(np.asarray(array), np.asarray(same))


def test_masks_in_lists_are_unknown_ground(function, ground):
    equal(function([masked(ground), masked(ground)]), function(np.stack([ground, ground])))
    equal(function(tuple(masked(ground))), function(ground))  # a tuple of rows


def test_masks_in_lists_reach_the_estimator(maps):
    heights = maps["holes"]
    hidden = np.ma.masked_array(np.nan_to_num(heights, nan=-9999), np.isnan(heights))
    np.testing.assert_array_equal(predict([hidden]), predict(heights[None]))


@pytest.mark.parametrize("mark", MARKERS)
@pytest.mark.parametrize("kind", ["f4", ">f4", "f8", ">f8", "i4", ">i4", "f2", jnp.bfloat16, "list", "object"])
def test_usual_marks_of_unknown_ground_are_refused(function, mark, kind):
    heights = np.zeros((2, *GRID.shape))
    heights[1, 3, 4] = mark
    with np.errstate(over="ignore"):  # -99999 in two bytes
        given = heights.tolist() if kind == "list" else heights.astype(kind)
    with pytest.raises(InputError, match="^heights = .*: .*must be metres.*, or NaN where unknown$"):
        function(given)


def test_a_mark_in_two_bytes_is_named():
    heights = np.zeros(GRID.shape, np.float16)
    heights[0, 0] = -9999
    with pytest.raises(
        InputError, match="^heights = -10000: is a usual mark of unknown ground; must be metres, or NaN"
    ):
        as_maps(heights, GRID)
    as_maps(heights.astype(np.float32), GRID)  # a height like any other


@pytest.mark.parametrize("height", [-9998.0, 9998.5, -29_999.0])
def test_other_heights_are_no_marks(height):
    maps, alone = as_maps(np.full(GRID.shape, height), GRID)
    assert alone and not np.asarray(maps).any()  # relative to the centre


def test_a_mark_in_the_estimators_map_is_refused():
    heights = np.zeros((129, 129), np.float32)
    heights[5, 5] = -9999
    with pytest.raises(InputError, match="^heights = -9999: is a usual mark"):
        predict(heights)


def test_heights_of_a_jax_array_are_not_looked_at(function, ground):
    """What is infinite, beyond 30 km or a usual mark is unknown."""
    given = jnp.asarray(ground - 2000, jnp.float32)
    wild = jnp.where(jnp.isnan(given), jnp.asarray([jnp.inf, -1e9])[jnp.arange(GRID.nodes) % 2], given)
    equal(function(wild), function(given))


def test_what_is_infinite_in_a_jax_array_is_unknown_to_the_estimator(maps):
    heights = maps["holes"]
    np.testing.assert_array_equal(predict(jnp.asarray(np.nan_to_num(heights, nan=np.inf))), predict(heights))


@pytest.mark.parametrize("mark", MARKERS)
@pytest.mark.parametrize("kind", ["float32", "int32", "float64"])
def test_a_mark_in_a_jax_array_is_unknown(function, mark, kind):
    heights = np.random.default_rng(1).integers(-1, 2, GRID.shape).astype(float)
    heights[3:5, 4] = np.nan
    with jax.enable_x64(True):
        equal(function(jnp.asarray(np.nan_to_num(heights, nan=mark), jnp.dtype(kind))), function(heights))


@pytest.mark.parametrize(
    ("kind", "height", "step"), [("f2", 2000, "1 m"), (">f2", 100, "0.0625 m"), (jnp.bfloat16, 9, "0.0625 m")]
)
def test_heights_in_coarse_steps_are_refused(function, kind, height, step):
    given = (np.zeros(GRID.shape) + height).astype(kind)
    with pytest.raises(InputError, match=f"^heights = {height}: is stored in steps of {step}"):
        function(given)
    function((given.astype(np.float64) - height).astype(kind))


@pytest.mark.parametrize("height", [0, 2000, 4500])
def test_a_jax_array_of_64_bits_is_taken_relative_to_the_centre_first(function, ground, height):
    heights = ground - 2000 + height
    with jax.enable_x64(True):
        equal(function(jnp.asarray(heights)), function(heights))
        equal(function(jax.jit(lambda z: z + 1)(jnp.asarray(heights))), function(heights + 1))


@pytest.mark.parametrize("kind", [">f4", "<f4", ">f8", ">i2", ">i8", "<u4"])
def test_byte_order_changes_nothing(function, kind):
    heights = np.random.default_rng(0).integers(0, 3, GRID.shape).astype(float)
    equal(function(heights.astype(kind)), function(heights))


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float32", "float64"])
def test_tensors_and_arrays_of_short_numbers_are_maps(function, ground, kind):
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(ground - 2000).to(getattr(torch, kind)).requires_grad_()
    wanted = function(tensor.detach().double().numpy())
    equal(function(tensor), wanted)
    with jax.enable_x64(True):
        equal(function(jnp.asarray(tensor.detach().double().numpy(), jnp.dtype(kind))), wanted)


@pytest.mark.parametrize(
    "wrong",
    [
        0.0,
        [],
        [[]],
        [[[]]],
        "site.tif",
        None,
        [[0.0, 1.0], [2.0]],
        [np.zeros(GRID.shape), np.zeros((3, 3))],
        np.zeros(GRID.shape, bool),
        np.zeros(GRID.shape, complex),
        np.zeros((0, *GRID.shape)),
        np.zeros((1, 1, *GRID.shape)),
        np.zeros(GRID.shape)[:-1],
        np.full(GRID.shape, "1"),
        jnp.zeros(GRID.shape, bool),
        jnp.zeros(GRID.shape, jnp.complex64),
        jax.random.split(jax.random.key(0), GRID.shape),
        jnp.zeros((3, 3)),
        {"heights": np.zeros(GRID.shape)},
        (row for row in np.zeros(GRID.shape)),
    ],
    ids=lambda wrong: repr(wrong)[:20],
)
def test_what_is_no_map_is_refused_in_one_line(function, wrong):
    with pytest.raises(InputError, match="^heights.*: must ") as refusal:
        function(wrong)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("grid", [(4, 0.125), [4, 0.125], None, 0.125, "4 m", ACTIONS])
def test_a_grid_that_is_none_is_refused(function, grid):
    params, seeds = sample_params("rough", 0)
    refused = pytest.raises(
        InputError, match=r"^grid = .*: must be a travjax\.Grid, such as Grid\(size=8, spacing=0\.0625\)$"
    )
    with refused:
        function(np.zeros(GRID.shape), grid)
    with refused:
        generate_terrain("rough", 0, grid=grid)
    with refused:
        elevation(params, seeds, grid=grid)


@pytest.mark.parametrize("actions", [(18, 1.65), "paper", [], 0])
def test_actions_that_are_none_are_refused(actions):
    for call in (
        lambda: simulate(np.zeros(GRID.shape), None, actions, grid=GRID),
        lambda: render_inputs(np.zeros(GRID.shape), 0, 0, None, actions, grid=GRID),
    ):
        with pytest.raises(InputError, match="^actions = .*: must be a travjax.ActionSpace$"):
            call()
