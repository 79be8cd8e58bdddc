"""Flags of JAX: seeds, files, margins and probabilities are the same whatever an application has set."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import field_runs, small_training
from travjax.jax_flags import key_of, usual_flags
from travjax.models.input_images import render_inputs
from travjax.runs.predictor import Predictor
from travjax.terrain.noise import noise2
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal.traverse import label, simulate

FLAGS = {
    "jax_enable_x64": True,
    "jax_threefry_partitionable": False,
    "jax_default_prng_impl": "rbg",
    "jax_random_seed_offset": 7,
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_default_matmul_precision": "bfloat16",
    "jax_debug_nans": True,
    "jax_debug_infs": True,
    "jax_transfer_guard": "disallow",
    "jax_disable_jit": True,
}


@contextmanager
def flags_set(flags: dict = FLAGS) -> Iterator[None]:
    """As an application sets them, for all threads; afterwards as they were."""
    before = {name: getattr(jax.config, name) for name in flags}
    try:
        for name, value in flags.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def equal(one, other) -> None:
    """Trees of arrays, bit for bit and of the same types."""
    leaves, others = ([np.asarray(leaf) for leaf in jax.tree.leaves(tree)] for tree in (one, other))
    assert [leaf.dtype for leaf in leaves] == [leaf.dtype for leaf in others]
    for leaf, same in zip(leaves, others, strict=True):
        np.testing.assert_array_equal(leaf, same)


@pytest.fixture(scope="module")
def few_maps(maps) -> np.ndarray:
    return np.stack([maps["rough"], maps["holes"]])


@pytest.mark.parametrize("flag", FLAGS)
def test_a_style_and_seed_is_the_same_map_whatever_flag_is_set(flag):
    """Among twelve maps of a style each of its halves occurs."""
    styles = np.repeat(STYLES, 12).tolist()
    seeds = np.tile(np.arange(12), len(STYLES))
    wanted = generate_terrain(styles, seeds)
    with flags_set({flag: FLAGS[flag]}):
        equal(generate_terrain(styles, seeds), wanted)


def test_margins_labels_inputs_and_noise_are_the_same(few_maps):
    def results():
        images = render_inputs(few_maps, [0, 1], [5, 3000])
        return simulate(few_maps), label(few_maps[0]), images, noise2([3, 4], np.linspace(-5, 5, 50), np.zeros(50))

    wanted = results()
    with flags_set():
        equal(results(), wanted)


def test_arrays_of_64_bits_and_traced_ones_have_the_same_margins(few_maps):
    wanted = simulate(few_maps)
    with flags_set({"jax_enable_x64": True}):
        heights = jnp.asarray(few_maps, jnp.float64)
        equal(simulate(heights), wanted)
        equal(jax.jit(simulate)(heights), wanted)


def test_probabilities_of_the_estimator_that_comes_with_the_package_are_the_same(few_maps):
    wanted = Predictor.load().predict(few_maps)
    with flags_set():
        found = Predictor.load().predict(few_maps)
    equal((found.probability, found.margins), (wanted.probability, wanted.margins))


@pytest.mark.parametrize("runs", [small_training, field_runs], ids=["resnet50", "field"])
def test_a_run_is_the_same_and_goes_on_from_checkpoints_of_other_flags(runs, tmp_path, shared_code):
    """First weights, order, dropout, corruption and optimizer of a run that began under flags and went on without."""
    epochs = {"head_epochs": 1} if runs is small_training else {}
    through = runs.begun(tmp_path / "through", epochs=2, **epochs)
    through.train()
    with flags_set({name: value for name, value in FLAGS.items() if name != "jax_disable_jit"}):
        runs.begun(tmp_path / "begun", epochs=1, **epochs).train()
    more = runs.trainer(tmp_path / "begun", epochs=2, **epochs)
    more.resume()
    more.train()
    small_training.require_equal(small_training.host(more.state), small_training.host(through.state))
    with flags_set():
        again = runs.trainer(tmp_path / "through", epochs=2, **epochs)
        again.resume()
    small_training.require_equal(small_training.host(again.state), small_training.host(through.state))


def test_a_fresh_process_under_all_flags_gives_the_same_bits(few_maps, tmp_path):
    """Nothing that is computed at import, or kept from one call to the next, hangs on them either."""
    code = (
        "import sys, numpy as np, travjax; heights = np.load(sys.argv[1]); "
        "margins = travjax.simulate(heights); maps = travjax.generate_terrain('wavy', range(3)); "
        "np.savez(sys.argv[2], step=margins.step, obstacle=margins.obstacle, tilt=margins.tilt, maps=maps)"
    )
    np.save(tmp_path / "heights.npy", few_maps)
    environment = os.environ | {name.upper(): str(value) for name, value in FLAGS.items()}
    words = [sys.executable, "-c", code, str(tmp_path / "heights.npy"), str(tmp_path / "found.npz")]
    subprocess.run(words, env=environment, check=True)
    margins = simulate(few_maps)
    with np.load(tmp_path / "found.npz") as found:
        wanted = (margins.step, margins.obstacle, margins.tilt, generate_terrain("wavy", range(3)))
        equal([found[name] for name in ("step", "obstacle", "tilt", "maps")], wanted)


def test_the_callers_own_flags_stay():
    with flags_set():
        generate_terrain("wavy", 1)
        assert {name: getattr(jax.config, name) for name in FLAGS} == FLAGS


def test_usual_flags_are_those_of_jax_when_nothing_is_set():
    names = [name for name in FLAGS if name != "jax_random_seed_offset"]  # keys do not look at it
    code = f"import jax; print([getattr(jax.config, name) for name in {names}])"
    bare = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    shown = subprocess.run([sys.executable, "-c", code], env=bare, check=True, capture_output=True, text=True).stdout
    with flags_set(), usual_flags():
        found = [getattr(jax.config, name) for name in names]
    found[names.index("jax_transfer_guard")] = None  # "allow" is what JAX does without a guard
    assert str(found) == shown.strip()


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1, 2**32 - 1])
def test_a_key_is_that_of_jax_for_the_seed(seed):
    wanted = jax.random.key(np.uint32(seed), impl="threefry2x32")
    with flags_set(
        {name: FLAGS[name] for name in ("jax_default_prng_impl", "jax_random_seed_offset", "jax_enable_x64")}
    ):
        found = key_of(seed)
    assert found.dtype == wanted.dtype
    np.testing.assert_array_equal(jax.random.key_data(found), jax.random.key_data(wanted))
