"""The estimator against plain NumPy on the trunk's features, its dropout, its parts, and how it is made."""

import functools

import jax
import numpy as np
import pytest
from flax import nnx

from tests.small_training import PRESET, differing, estimator, features_of, forward, host, in_training, require_equal
from travjax.config import InputError
from travjax.models.trajectory_resnet import HeadsConfig, create
from travjax.models.variables import VARIABLES, merge_model, split_model
from travjax.resnet.imagenet_weights import Weights
from travjax.resnet.network import ResNetConfig
from travjax.simulation.events import EVENTS

IMAGES = np.random.default_rng(0).uniform(-1, 1, (6, 33, 33, 3)).astype(np.float32)
TRUNK = PRESET.trunk


def weights_of(made, **other) -> Weights:
    """The trunk of an estimator as if it came from a file."""
    kinds = {"kernel": "kernel", "scale": "gamma", "bias": "beta", "mean": "mean", "var": "var"}
    arrays = {}
    for name, array in host(nnx.state(made.trunk)).items():
        *layer, kind = name.split("/")
        arrays[f"{'_'.join(layer)}/{kinds[kind]}"] = array
    settings = dict(path="file", naming="own", origin="file", stride_in="1x1", epsilon=TRUNK.epsilon)
    return Weights(arrays, **(settings | other))


def logits_of(made, images=IMAGES) -> np.ndarray:
    return np.asarray(forward(*split_model(made), images))


@functools.partial(jax.jit, static_argnums=0)
def after_evaluation(graph, variables, images, key):
    """The variables after a forward pass without training, with dropout even."""
    made = merge_model(graph, variables)
    made(images, key=key)
    return split_model(made)[1]


# ---- What it computes


def test_logits_are_those_of_numpy_in_the_order_of_the_events():
    made = estimator()
    features = np.asarray(features_of(*split_model(made), IMAGES), np.float64)
    heads = {name: array.astype(np.float64) for name, array in host(nnx.state(made.heads, nnx.Param)).items()}
    wanted = []
    for event in ("step", "obstacle", "tilt"):
        hidden = features @ heads[f"{event}/hidden/kernel"] + heads[f"{event}/hidden/bias"]
        wanted.append((np.maximum(hidden, 0) @ heads[f"{event}/logit/kernel"] + heads[f"{event}/logit/bias"])[:, 0])
    np.testing.assert_allclose(logits_of(made), np.stack(wanted, axis=1), rtol=1e-4, atol=1e-5)


def test_each_sample_is_on_its_own_without_batch_statistics():
    company = IMAGES[[2, 3, 0, 0, 5, 5]]
    np.testing.assert_allclose(logits_of(estimator(), company)[:2], logits_of(estimator())[2:4], rtol=1e-4, atol=1e-5)


def test_only_training_moves_the_running_statistics():
    graph, variables = split_model(estimator())
    require_equal(host(after_evaluation(graph, variables, IMAGES, jax.random.key(0))), host(variables))
    moved = differing(host(in_training(graph, variables, IMAGES, jax.random.key(0))[1]), host(variables))
    assert moved == {name for name in host(variables) if name.endswith(("/mean", "/var"))}


# ---- Dropout


def share_kept(dropout: float, key) -> np.ndarray:
    """Heads that sum up 4096 hidden units that are all 1: logits / 4096 [b, 3]."""
    made = create(TRUNK, HeadsConfig(4096, dropout)).heads
    for event in EVENTS:
        head = getattr(made, event)
        for variable, value in ((head.hidden.kernel, 0), (head.hidden.bias, 1), (head.logit.kernel, 1)):
            variable.set_value(jax.numpy.full(variable.shape, value, np.float32))
    return np.asarray(made(np.zeros((5, TRUNK.features), np.float32), key)) / 4096


def test_dropout_leaves_out_its_share_and_scales_up_the_rest():
    sums = share_kept(0.2, jax.random.key(0))
    assert 0.9 < sums.min() < sums.max() < 1.1
    assert len(np.unique(sums)) > 12  # other units for each sample and event
    kept = sums * 4096 * 0.8
    np.testing.assert_allclose(kept, kept.round(), atol=1e-2)  # each unit counts 1 / 0.8 or nothing
    half = share_kept(0.5, jax.random.key(0)) * 4096
    np.testing.assert_allclose(half, 2 * (half / 2).round(), atol=1e-2)


def test_dropout_is_off_without_a_key():
    np.testing.assert_array_equal(share_kept(0.2, None), 1)
    np.testing.assert_array_equal(share_kept(0.0, jax.random.key(0)), 1)


def test_dropout_follows_from_the_key():
    one, same, other = (share_kept(0.2, jax.random.key(number)) for number in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


# ---- Making it, taking it apart


def test_the_same_seed_makes_the_same_estimator():
    one, same, other = (host(nnx.state(create(TRUNK, HeadsConfig(16), seed))) for seed in (3, 3, 4))
    require_equal(one, same)
    kernels = {name for name in one if name.endswith("kernel")}
    assert differing(one, other) == kernels


def test_heads_start_different_from_each_other_and_do_not_depend_on_the_trunk():
    heads = host(nnx.state(create(TRUNK, HeadsConfig(16)).heads, nnx.Param))
    first = [heads[f"{event}/hidden/kernel"] for event in EVENTS]
    assert (first[0] != first[1]).any() and (first[1] != first[2]).any()
    given = create(TRUNK, HeadsConfig(16), 0, weights_of(estimator(5)))
    require_equal(host(nnx.state(given.heads, nnx.Param)), heads)


def test_weights_set_the_trunk():
    made = create(TRUNK, HeadsConfig(16), 0, weights_of(estimator(5)))
    actual, wanted = host(nnx.state(made.trunk)), host(nnx.state(estimator(5).trunk))
    assert actual.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_allclose(actual[name], array, rtol=1e-6, err_msg=name)  # gamma is computed
    features = [features_of(*split_model(one), IMAGES) for one in (made, estimator(5))]
    np.testing.assert_allclose(*features, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("config", "other", "field"),
    [
        (ResNetConfig(blocks=(1,), width=8), {}, "config = "),
        (ResNetConfig(blocks=(1, 1), width=4), {}, "config = "),
        (TRUNK, {"stride_in": "3x3"}, "stride_in = "),
    ],
)
def test_weights_of_another_trunk_are_refused(config, other, field):
    with pytest.raises(InputError) as raised:
        create(config, HeadsConfig(16), 0, weights_of(estimator(5), **other))
    assert str(raised.value).startswith(field) and "\n" not in str(raised.value)


def test_taken_apart_and_put_together_it_is_the_same_with_variables_of_its_own():
    graph, variables = split_model(estimator())
    assert tuple(variables) == VARIABLES == ("trunk", "heads", "statistics")
    names = {part: set(host(state)) for part, state in variables.items()}
    assert all(name.endswith(("/mean", "/var")) for name in names["statistics"])
    assert {name.split("/")[0] for name in names["heads"]} == {"heads"}
    assert len(names["trunk"]) == 3 * 5 and len(names["statistics"]) == 2 * 5 and len(names["heads"]) == 3 * 4
    before = host(variables)
    again = merge_model(graph, variables)
    np.testing.assert_array_equal(logits_of(again), logits_of(estimator()))
    again.trunk.conv1.mean[...] += 1
    again.heads.step.logit.bias[...] += 1
    require_equal(host(variables), before)
    require_equal(host(split_model(estimator())[1]), before)


def test_estimators_of_the_same_configuration_share_their_graph():
    """`jit` compiles once for it."""
    one, other = (split_model(create(TRUNK, HeadsConfig(16), seed))[0] for seed in (0, 1))
    assert one == other and hash(one) == hash(other)


# ---- Bad input


@pytest.mark.parametrize("hidden", [0, -1, 1.5, True, 65537, "16"])
def test_a_number_of_units_that_cannot_be_is_refused(hidden):
    with pytest.raises(InputError, match="^hidden = .*: must be a number from 1 to 65536$"):
        HeadsConfig(hidden=hidden)


@pytest.mark.parametrize("dropout", [-0.1, 1.0, 2, float("nan"), True, "0.2"])
def test_a_share_that_cannot_be_dropped_is_refused(dropout):
    with pytest.raises(InputError, match="^dropout = .*: must be a share from 0, below 1$"):
        HeadsConfig(dropout=dropout)
