"""What the numbers of a first layer tell of its input: on the layer of trained weights, converted by float64 here."""

import os
from pathlib import Path

import numpy as np
import pytest

from travjax.config import InputError
from travjax.resnet.preprocessing import INPUTS, LEAST, MOST, converted, require_fit, require_statistics

SHARED = Path(os.environ.get("TRAVJAX_DATA", Path(__file__).parents[2] / "../shared/data")) / "imagenet"
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])

UNITS = {
    "torch": (np.ones(3), np.zeros(3), 1),
    "torch-bgr": (np.ones(3), np.zeros(3), -1),
    "caffe": (255 * STD, np.zeros(3), -1),
    "caffe-rgb": (255 * STD, np.zeros(3), 1),
    "tf": (2 * STD, 2 * MEAN - 1, 1),
    "unit": (STD, MEAN, 1),
}
"""For each input: scale and offset of R, G, B against (x / 255 - mean) / std, and the step through the colours."""

KINDS = ("kernel", "gamma", "beta", "mean", "var")
NAMES = {f"conv1/{kind}": f"first.{kind}" for kind in KINDS}


@pytest.fixture(scope="module")
def trained() -> dict[str, np.ndarray]:
    """The first layer of resnet50_imagenet.npz."""
    path = SHARED / "resnet50_imagenet.npz"
    if not path.is_file():
        pytest.skip(f"needs {path} (TRAVJAX_DATA is the folder above)")
    with np.load(path) as file:
        return {name: file[name].astype(np.float32) for name in NAMES}


def made_for(trained: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """The layer that does to pixels of another input what this one does to its own."""
    scale, offset, step = UNITS[name]
    kernel = trained["conv1/kernel"] / scale[:, None]
    mean = trained["conv1/mean"] + kernel.sum((0, 1)).T @ offset
    return trained | {"conv1/kernel": kernel[:, :, ::step], "conv1/mean": mean}


def told(layer: dict[str, np.ndarray], assumed: str) -> str | None:
    """The refusal of a layer that is taken for another."""
    try:
        require_fit(converted(layer, INPUTS[assumed]), assumed, NAMES)
    except InputError as error:
        return str(error)
    return None


def test_all_inputs_are_there():
    assert INPUTS.keys() == UNITS.keys()


@pytest.mark.parametrize("name", INPUTS)
def test_a_layer_is_converted_to_what_it_was(trained, name):
    layer = converted(made_for(trained, name), INPUTS[name])
    for kind in NAMES:
        np.testing.assert_allclose(layer[kind], trained[kind], rtol=1e-5, atol=1e-6)
    assert told(made_for(trained, name), name) is None


@pytest.mark.parametrize(
    ("name", "assumed", "option"),
    [
        ("caffe", "torch", "--input caffe --stride-in 1x1 "),
        ("caffe-rgb", "torch", "(or caffe-rgb)"),
        ("torch", "caffe", "--input torch "),
        ("tf", "caffe", "(or torch-bgr or tf or unit)"),
        ("unit", "caffe", "(or torch-bgr or tf or unit)"),
        ("tf", "torch", "--input tf "),
        ("unit", "torch", "--input unit "),
        ("torch", "tf", "--input torch "),
        ("torch", "unit", "--input torch "),
        ("unit", "tf", "--input unit "),
        ("tf", "unit", "--input tf "),
        ("tf", "torch-bgr", "--input tf "),
        ("unit", "torch-bgr", "--input unit "),
    ],
)
def test_a_layer_that_is_taken_for_another_is_refused(trained, name, assumed, option):
    message = told(made_for(trained, name), assumed)
    assert message and option in message and "first." in message and "\n" not in message
    assert f"--input {assumed} " not in message  # it would be refused again


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("colours", [(0.1, -0.1, 0.1), (-0.3, -0.3, -0.3), (0.2, 0.2, 0.1)], ids=str)
def test_a_layer_of_images_of_another_mean_is_believed(trained, name, colours):
    """Those of a survey, say, are darker or lighter than ImageNet's."""
    sums = trained["conv1/kernel"].sum((0, 1)).T
    layer = trained | {"conv1/mean": trained["conv1/mean"] + sums @ np.array(colours)}
    assert told(made_for(layer, name), name) is None


@pytest.mark.parametrize(("name", "assumed"), [("torch-bgr", "torch"), ("caffe-rgb", "caffe")])
def test_the_order_of_the_colours_cannot_be_told(trained, name, assumed):
    assert told(made_for(trained, name), assumed) is None


@pytest.mark.parametrize(("factor", "fitting"), [(1e6, None), (255, None), (1e-6, None), (1 / 255, "caffe")])
def test_only_inputs_that_a_layer_would_fit_are_named(trained, factor, fitting):
    layer = trained | {"conv1/kernel": trained["conv1/kernel"] * np.float32(factor)}
    hint = f"--input {fitting} --stride-in 1x1 takes" if fitting else "; there is no --input that it would fit"
    assert hint in (told(layer, "torch") or "")
    assert [name for name in INPUTS if told(layer, name) is None] == (["caffe", "caffe-rgb"] if fitting else [])


def test_the_sizes_that_are_allowed_hold_whatever_images_are_taken_in():
    """No image from 0 to 1 gives more than MOST: the two most different ones, black and white, by an even kernel."""
    kernel = np.ones((7, 7, 3)) * (1 / STD) * 0.1  # the filter that makes the most of their difference
    out = [(kernel * (x - MEAN) / STD).sum() for x in (0, 1)]
    assert np.var(out) / np.sum(kernel**2) == pytest.approx(MOST, rel=1e-6)
    assert LEAST < 1 < MOST


def test_random_layers_are_not_told_from_their_means():
    """Numbers that no three colours explain, and few filters."""
    random = np.random.default_rng(0)
    for filters in (64, 4):
        layer = {
            "conv1/kernel": random.normal(0, 0.1, (7, 7, 3, filters)).astype(np.float32),
            "conv1/gamma": np.ones(filters),
            "conv1/mean": random.uniform(-0.3, 0.3, filters),
            "conv1/var": random.uniform(0.5, 1.5, filters),
        }
        assert told(layer, "torch") is None


def test_filters_that_are_dead_count_for_nothing(trained):
    layer = {name: array.copy() for name, array in trained.items()}
    layer["conv1/kernel"][..., :20] = 0
    layer["conv1/var"][:20] = 1
    layer["conv1/kernel"][..., 20:40] *= 1e-9
    layer["conv1/gamma"][20:40] = 0
    assert told(layer, "torch") is None
    layer["conv1/gamma"][:] = 0
    assert told(layer, "torch") is None


def test_statistics_of_0_and_1_are_none_unless_nothing_was_trained():
    names = {f"{layer}/{kind}": f"{layer}.{kind}" for layer in ("conv1", "second") for kind in KINDS}
    fresh = {"gamma": np.ones(4), "beta": np.zeros(4), "mean": np.zeros(4), "var": np.ones(4), "kernel": np.ones(4)}
    arrays = {name: fresh[name.split("/")[1]].copy() for name in names}
    require_statistics(arrays, names)
    arrays["second/gamma"][1] = 0.5
    arrays["second/var"] -= 1e-5  # as Detectron2 writes it
    with pytest.raises(InputError, match="^conv1.mean = 0 and conv1.var = 1, as in all 2 norms: must be statistics"):
        require_statistics(arrays, names)
    arrays["second/mean"][2] = 0.1
    require_statistics(arrays, names)
