"""Converted weights against Keras, torch and recorded activations, and the one line for each file that is wrong.

The names in the files are written here by the oracles, never by the module under test.
"""

import io
import json
import os
import pickle
import re
import sys
import warnings
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import huggingface_hub
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import load_file, save_file

from travjax.config import InputError
from travjax.resnet.imagenet_weights import Weights, apply_weights, describe, fetch, load_weights, save_safetensors
from travjax.resnet.network import ResNet, ResNetConfig
from travjax.resnet.preprocessing import INPUTS

NARROW = ResNetConfig(width=4)
"""All the layers of ResNet50, so all of their names, and few channels."""

SHARED = Path(os.environ.get("TRAVJAX_DATA", Path(__file__).parents[2] / "../shared/data")) / "imagenet"
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
BLOCKS = {2: "abc", 3: "abcd", 4: "abcdef", 5: "abc"}
SUFFIXES = [".npz", ".h5", ".safetensors", ".pth"]

PIXELS = 64.0
"""A first kernel of Keras is so many times smaller, as it is for pixels up to 255."""


def canonical_arrays(width: int = 4, top: bool = True, seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights and statistics of a ResNet50 by canonical name, in a layout written down once more."""
    random = np.random.default_rng(seed)
    layers = {"conv1": (7, 3, width)}
    inputs = width
    for stage, letters in BLOCKS.items():
        inner = width * 2 ** (stage - 2)
        for letter in letters:
            block = f"res{stage}{letter}_branch"
            layers |= {f"{block}2a": (1, inputs, inner), f"{block}2b": (3, inner, inner)}
            layers[f"{block}2c"] = (1, inner, 4 * inner)
            if letter == "a":
                layers[f"{block}1"] = (1, inputs, 4 * inner)
            inputs = 4 * inner
    arrays = {}
    for layer, (size, fan_in, out) in layers.items():
        spread = np.sqrt(2 / (size**2 * fan_in))
        arrays[f"{layer}/kernel"] = spread * random.standard_normal((size, size, fan_in, out), np.float32)
        for array, low, high in (("gamma", 0.3, 0.9), ("beta", -0.3, 0.3), ("mean", -0.3, 0.3), ("var", 0.5, 1.5)):
            arrays[f"{layer}/{array}"] = random.uniform(low, high, out)
    if top:
        arrays["fc1000/kernel"] = random.standard_normal((inputs, 1000)) / np.sqrt(inputs)
        arrays["fc1000/bias"] = random.standard_normal(1000)
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def torchvision_arrays(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same in the names and layout of torchvision."""
    convolutions = {"2a": "conv1", "2b": "conv2", "2c": "conv3", "1": "downsample.0"}
    norms = {"2a": "bn1", "2b": "bn2", "2c": "bn3", "1": "downsample.1"}
    kinds = {"gamma": "weight", "beta": "bias", "mean": "running_mean", "var": "running_var"}
    named = {}
    for name, array in arrays.items():
        layer, kind = name.split("/")
        if layer == "fc1000":
            named["fc.weight" if kind == "kernel" else "fc.bias"] = np.ascontiguousarray(array.T)
            continue
        block, convolution, norm = "", "conv1", "bn1"
        if layer != "conv1":
            branch = layer.split("_branch")[1]
            block = f"layer{int(layer[3]) - 1}.{'abcdef'.index(layer[4])}."
            convolution, norm = convolutions[branch], norms[branch]
        if kind == "kernel":
            named[f"{block}{convolution}.weight"] = np.ascontiguousarray(array.transpose(3, 2, 0, 1))
            named[f"{block}{norm}.num_batches_tracked"] = np.array(7)
        else:
            named[f"{block}{norm}.{kinds[kind]}"] = array
    return named


def write(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Arrays by the names that they have in the file; in an .h5 they lie a group deeper, as Keras 2 does it."""
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix == ".safetensors":
        save_file(arrays, path)
    elif path.suffix == ".pth":
        torch = pytest.importorskip("torch")
        torch.save({name: torch.tensor(np.array(array)) for name, array in arrays.items()}, path)
    else:
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[f"{name.split('/')[0]}/{name}:0"] = array
    return path


def keras_arrays(arrays: dict[str, np.ndarray], caffe: bool = False) -> dict[str, np.ndarray]:
    """Canonical arrays in the names of Keras, with biases of zero, as "layer/array"; conv1 is for larger pixels."""
    arrays = arrays | {"conv1/kernel": arrays["conv1/kernel"] / np.float32(PIXELS)}
    kinds = {"gamma": "gamma", "beta": "beta", "mean": "moving_mean", "var": "moving_variance"}
    named = {}
    for name, array in arrays.items():
        layer, kind = name.split("/")
        if layer == "fc1000":
            named[name if caffe else f"predictions/{kind}"] = array
            continue
        norm = "bn_conv1" if layer == "conv1" else f"bn{layer[3:]}"
        convolution = layer
        if not caffe:
            block = f"conv{layer[3]}_block{'abcdef'.index(layer[4]) + 1}_" if layer != "conv1" else "conv1"
            number = {"1": "0", "2a": "1", "2b": "2", "2c": "3"}[layer.split("_branch")[1]] if layer != "conv1" else ""
            convolution, norm = f"{block}{number}_conv", f"{block}{number}_bn"
        if kind == "kernel":
            named[f"{convolution}/kernel"] = array
            named[f"{convolution}/bias"] = np.zeros(array.shape[-1], np.float32)
        else:
            named[f"{norm}/{kinds[kind]}"] = array
    return named


def arrays_in_file(suffix: str, **options) -> dict[str, np.ndarray]:
    """Weights of NARROW as a file of this kind names them."""
    arrays = canonical_arrays(**options)
    return {".npz": lambda a: a, ".h5": keras_arrays}.get(suffix, torchvision_arrays)(arrays)


def run(weights: Weights, images: np.ndarray, **config) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Features and stages of a network with these weights."""
    config = replace(ResNetConfig(stride_in=weights.stride_in), **config)
    resnet = nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(0)))
    apply_weights(resnet, weights)
    return forward(*nnx.split(resnet), images)


@partial(jax.jit, static_argnums=0)
def forward(graph, state, images):
    return nnx.merge(graph, state)(images)


def assert_close(found, wanted, rtol: float = 1e-4):
    """To a share of the largest value."""
    wanted = np.asarray(wanted)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=rtol * np.abs(wanted).max())


def normalised(count: int = 2, size: int = 64) -> np.ndarray:
    """Made-up (x / 255 - mean) / std of RGB pixels."""
    return np.random.default_rng(5).standard_normal((count, size, size, 3)).astype(np.float32)


# Keras


@pytest.fixture(scope="module")
def keras_model():
    """Keras' own ResNet50 with random weights, biases and statistics."""
    os.environ["KERAS_BACKEND"] = "numpy"  # which compiles nothing
    keras = pytest.importorskip("keras")
    model = keras.applications.ResNet50(weights=None, input_shape=(64, 64, 3))
    random = np.random.default_rng(1)
    for layer in model.layers:
        for variable in layer.weights:
            shape, kind = variable.shape, variable.path.split("/")[-1]
            if kind == "kernel":
                value = random.standard_normal(shape, np.float32) * np.sqrt(2 / np.prod(shape[:-1]))
            else:
                value = random.uniform(
                    *{"gamma": (0.3, 0.9), "moving_variance": (0.5, 1.5)}.get(kind, (-0.3, 0.3)), shape
                )
            variable.assign(value)
    first = model.get_layer("conv1_conv").kernel
    first.assign(first / 60)  # made for pixels of 0 to 255
    return model


@pytest.fixture(scope="module")
def keras_stages(keras_model) -> dict[str, np.ndarray]:
    """What Keras computes, from its own kind of pixels."""
    import keras

    layers = {
        "stem": "pool1_pool",
        "stage2": "conv2_block3_out",
        "stage3": "conv3_block4_out",
        "stage4": "conv4_block6_out",
        "stage5": "conv5_block3_out",
        "features": "avg_pool",
        "classes": "predictions",
    }
    outputs = {name: keras_model.get_layer(layer).output for name, layer in layers.items()}
    pixels = (normalised() * (255 * STD))[..., ::-1].astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Keras converts its arrays as NumPy 1 did
        computed = keras.Model(keras_model.input, outputs)(pixels, training=False)
    return {name: np.asarray(array) for name, array in computed.items()}


@pytest.fixture(scope="module")
def keras_weights(keras_model, tmp_path_factory) -> dict[str, Weights]:
    """What is read back from each kind of file that Keras 2 and 3 write, and from .keras of its first versions."""
    import keras
    from keras.src.legacy.saving import legacy_h5_format

    folder = tmp_path_factory.mktemp("keras")
    without_top = keras.Model(keras_model.input, keras_model.get_layer("conv5_block3_out").output)
    weights = {}
    for top, model in (("with top", keras_model), ("without top", without_top)):
        numbered, grouped = folder / "numbered.weights.h5", folder / "grouped.h5"
        with warnings.catch_warnings(), h5py.File(grouped, "w") as file:
            warnings.simplefilter("ignore", DeprecationWarning)  # as above
            model.save_weights(numbered)
            legacy_h5_format.save_weights_to_hdf5_group(file, model)
            model.save(folder / "whole.keras")
        weights[f"Keras 3, {top}"] = load_weights(numbered)
        weights[f"Keras 2, {top}"] = load_weights(grouped)
        weights[f".keras, {top}"] = load_weights(folder / "whole.keras")
        weights[f"unnamed .keras, {top}"] = load_weights(without_names(folder / "whole.keras"))
    return weights


def without_names(path: Path) -> Path:
    """The file as the first versions of Keras 3 wrote it, without the layers' names beside the arrays."""
    with zipfile.ZipFile(path) as archive:
        config, content = archive.read("config.json"), io.BytesIO(archive.read("model.weights.h5"))
    with h5py.File(content, "r+") as file:
        file.visititems(lambda place, item: item.attrs.pop("name", None) and None)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("config.json", config)
        archive.writestr("model.weights.h5", content.getvalue())
    return path


KINDS_OF_KERAS = ("Keras 2", "Keras 3", ".keras", "unnamed .keras")
LAYOUTS = [f"{kind}, {top} top" for kind in KINDS_OF_KERAS for top in ("with", "without")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_keras_gives_the_same_weights(keras_weights, layout):
    weights, first = keras_weights[layout], keras_weights[LAYOUTS[0]]
    assert (weights.classifier is None) == ("without" in layout)
    assert (weights.naming, weights.stride_in, weights.epsilon) == ("Keras", "1x1", 1.001e-5)
    assert len(weights.arrays) == 53 * 5 + (2 if "with top" in layout else 0)
    for name, array in weights.arrays.items():
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, first.arrays[name])


def test_a_trunk_in_another_model_of_keras_is_found(tmp_path):
    """With a head and an optimizer that has been used, as it is after fine-tuning."""
    keras = pytest.importorskip("keras")
    model = keras.Sequential([keras.Input((32, 32, 3)), keras.applications.ResNet50(weights=None, include_top=False)])
    model.add(keras.layers.GlobalAveragePooling2D())
    model.add(keras.layers.Dense(5))
    model.compile("sgd", "mse")
    model.optimizer.build(model.trainable_variables)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # as above
        model.save(tmp_path / "tuned.keras")
    weights = load_weights(tmp_path / "tuned.keras")
    assert weights.left_out == ("dense/bias [5]", "dense/kernel [2048, 5]") and weights.classifier is None
    kernel = model.layers[0].get_layer("conv4_block2_2_conv").kernel
    np.testing.assert_array_equal(weights.arrays["res4b_branch2b/kernel"], kernel)


def test_every_stage_of_a_converted_network_is_that_of_keras(keras_weights, keras_stages):
    weights = keras_weights["Keras 3, with top"]
    features, stages = run(weights, normalised())
    for name, stage in stages.items():
        assert np.abs(keras_stages[name]).max() > 0.1
        assert_close(stage, keras_stages[name])
    assert_close(features, keras_stages["features"])
    kernel, bias = weights.classifier
    assert_close(jax.nn.softmax(features @ kernel + bias), keras_stages["classes"])


def test_the_scale_of_the_first_kernel_brings_keras_to_the_range_of_the_others(keras_weights, keras_model):
    """White noise of unit variance comes out of it as it would of a kernel of He's variance."""
    kernel = keras_weights["Keras 3, with top"].arrays["conv1/kernel"]
    stored = np.asarray(keras_model.get_layer("conv1_conv").kernel)
    np.testing.assert_allclose(kernel[:, :, 0], stored[:, :, 2] * 255 * 0.229, rtol=1e-6)
    assert kernel.std() == pytest.approx(np.sqrt(2 / (49 * 3)), rel=0.1)


def test_names_of_keras_before_2_2(tmp_path):
    arrays = canonical_arrays()
    named = keras_arrays(arrays, caffe=True)
    random = np.random.default_rng(0)
    bias = {name: random.uniform(-1, 1, a.shape).astype(np.float32) for name, a in named.items() if "/bias" in name}
    old = {"kernel": "W_1", "bias": "b_1", "moving_mean": "running_mean_1", "moving_variance": "running_std_1"}
    keras_1 = tmp_path / "1.h5"
    with h5py.File(keras_1, "w") as file:
        for name, array in (named | bias).items():
            layer, kind = name.split("/")
            file[f"{layer}/{layer}_{old.get(kind, f'{kind}_1')}:0"] = array
    one, two = load_weights(keras_1, NARROW), load_weights(write(tmp_path / "2.h5", named | bias), NARROW)
    assert (one.naming, one.stride_in, one.epsilon) == ("Keras before 2.2", "1x1", 1e-3)
    np.testing.assert_array_equal(one.classifier[1], bias["fc1000/bias"])
    for name in arrays.keys() - {"conv1/kernel", "fc1000/bias"}:
        wanted = arrays[name] - bias[f"{name[:-5]}/bias"] if name.endswith("/mean") else arrays[name]
        np.testing.assert_array_equal(one.arrays[name], wanted)
        np.testing.assert_array_equal(two.arrays[name], wanted)


# torch


def torch_stages(arrays: dict[str, np.ndarray], images: np.ndarray, v1_5: bool) -> dict[str, np.ndarray]:
    """The network as torch functions on arrays in torchvision's names, float64."""
    torch = pytest.importorskip("torch")
    from torch.nn import functional

    state = {name: torch.tensor(np.array(array), dtype=torch.float64) for name, array in arrays.items()}

    def convolution(x, name, norm, stride, padding=0):
        x = functional.conv2d(x, state[f"{name}.weight"], stride=stride, padding=padding)
        kinds = ("running_mean", "running_var", "weight", "bias")
        return functional.batch_norm(x, *(state[f"{norm}.{kind}"] for kind in kinds), eps=1e-5)

    pixels_last = lambda x: x.permute(0, 2, 3, 1).numpy()
    x = torch.tensor(np.array(images), dtype=torch.float64).permute(0, 3, 1, 2)
    x = functional.max_pool2d(convolution(x, "conv1", "bn1", 2, 3).relu(), 3, 2, 1)
    stages = {"stem": pixels_last(x)}
    for layer, letters in enumerate(BLOCKS.values(), start=1):
        for block in range(len(letters)):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            first, second = (1, stride) if v1_5 else (stride, 1)
            y = convolution(x, f"{name}.conv1", f"{name}.bn1", first).relu()
            y = convolution(y, f"{name}.conv2", f"{name}.bn2", second, 1).relu()
            if block == 0:
                x = convolution(x, f"{name}.downsample.0", f"{name}.downsample.1", stride)
            x = (x + convolution(y, f"{name}.conv3", f"{name}.bn3", 1)).relu()
        stages[f"stage{layer + 1}"] = pixels_last(x)
    features = x.mean((2, 3))
    logits = functional.linear(features, state["fc.weight"], state["fc.bias"])
    return stages | {"features": features.numpy(), "logits": logits.numpy()}


@pytest.mark.parametrize(("suffix", "size"), [(".pth", 64), (".safetensors", 129)])
def test_every_stage_of_a_converted_network_is_that_of_torch(tmp_path, suffix, size):
    arrays = arrays_in_file(suffix)
    weights = load_weights(write(tmp_path / f"resnet50{suffix}", arrays), NARROW)
    assert (weights.naming, weights.stride_in, weights.epsilon) == ("torchvision", "3x3", 1e-5)
    wanted = torch_stages(arrays, normalised(size=size), v1_5=True)
    features, stages = run(weights, normalised(size=size), width=4)
    for name, stage in stages.items():
        assert_close(stage, wanted[name])
    assert_close(features, wanted["features"])
    kernel, bias = weights.classifier
    assert_close(features @ kernel + bias, wanted["logits"])


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_every_stage_of_a_v1_network_is_that_of_torch(tmp_path, suffix):
    arrays = canonical_arrays()
    weights = load_weights(write(tmp_path / f"resnet50{suffix}", arrays_in_file(suffix)), NARROW)
    wanted = torch_stages(torchvision_arrays(arrays), normalised(), v1_5=False)
    images = normalised()
    if suffix == ".h5":  # whose kernels take B, G, R of 0 to 255
        images = images[..., ::-1] * PIXELS / (255 * STD)
    features, stages = run(weights, images.astype(np.float32), width=4)
    for name, stage in stages.items():
        assert_close(stage, wanted[name])
    assert_close(features, wanted["features"])


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float64"])
def test_other_precisions_are_read_exactly(tmp_path, dtype):
    torch = pytest.importorskip("torch")
    arrays = {name: array for name, array in arrays_in_file(".pth").items() if "num_batches" not in name}
    rounded = {name: array.astype(jnp.dtype(dtype)) for name, array in arrays.items()}
    safe = load_weights(write(tmp_path / "a.safetensors", rounded), NARROW)
    torch.save(
        {name: torch.tensor(array).to(getattr(torch, dtype)) for name, array in arrays.items()}, tmp_path / "a.pth"
    )
    pth = load_weights(tmp_path / "a.pth", NARROW)
    wanted = rounded["layer3.5.conv2.weight"].astype(np.float32).transpose(2, 3, 1, 0)
    for weights in (pth, safe):
        assert {array.dtype for array in weights.arrays.values()} == {np.dtype(np.float32)}
        np.testing.assert_array_equal(weights.arrays["res4f_branch2b/kernel"], wanted)


# Other places, names and heads in a file


def nested(names: dict[str, np.ndarray], *prefixes: str) -> dict[str, np.ndarray]:
    """The arrays after prefixes."""
    return {"".join(prefixes) + name: array for name, array in names.items()}


@pytest.mark.parametrize("suffix", [".npz", ".safetensors", ".pth"])
@pytest.mark.parametrize("prefix", ["module.", "state_dict.", "model.", "state_dict.module.backbone.", "params/"])
def test_a_prefix_of_all_names_is_passed_over(tmp_path, suffix, prefix):
    arrays = nested(arrays_in_file(suffix), prefix)
    weights = load_weights(write(tmp_path / f"a{suffix}", arrays), NARROW)
    wanted = load_weights(write(tmp_path / f"b{suffix}", arrays_in_file(suffix)), NARROW)
    assert weights.arrays.keys() == wanted.arrays.keys() and weights.left_out == ()
    for name, array in weights.arrays.items():
        np.testing.assert_array_equal(array, wanted.arrays[name])


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".bin", ".ckpt", ".pth.tar"])
@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_of_a_training_run_is_read(tmp_path, suffix, zipped):
    torch = pytest.importorskip("torch")
    state = {f"module.{name}": torch.tensor(array) for name, array in arrays_in_file(".pth").items()}
    moments = {0: {"exp_avg": torch.zeros(3), "step": torch.tensor(7.0)}}
    run = {"epoch": 3, "state_dict": state, "optimizer": {"state": moments, "param_groups": [{"lr": 0.1}]}}
    path = tmp_path / f"checkpoint{suffix}"
    torch.save(run | {"loss": torch.zeros(2)}, path, _use_new_zipfile_serialization=zipped)
    weights = load_weights(path, NARROW)
    np.testing.assert_array_equal(weights.arrays["conv1/kernel"], canonical_arrays()["conv1/kernel"])
    assert weights.left_out == ("loss [2]",)
    assert re.search(r"left out +loss \[2\]; only the trunk is needed", describe(weights))


def hugging_face_arrays(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same in the names of transformers' ResNetForImageClassification."""
    named = {}
    for name, array in torchvision_arrays(arrays).items():
        parts = name.split(".")
        kind = "convolution" if "conv" in parts[-2] or parts[-2:-1] == ["0"] else "normalization"
        if parts[0] == "fc":
            named[f"classifier.1.{parts[1]}"] = array
        elif not parts[0].startswith("layer"):
            named[f"resnet.embedder.embedder.{kind}.{parts[-1]}"] = array
        else:
            inner = "shortcut" if parts[2] == "downsample" else f"layer.{int(parts[2][-1]) - 1}"
            place = f"resnet.encoder.stages.{int(parts[0][5:]) - 1}.layers.{parts[1]}"
            named[f"{place}.{inner}.{kind}.{parts[-1]}"] = array
    return named


def test_names_of_hugging_face(tmp_path):
    """As the modules of modeling_resnet.py in transformers are nested; four names written out."""
    named = hugging_face_arrays(canonical_arrays())
    assert {
        "resnet.embedder.embedder.convolution.weight",
        "resnet.encoder.stages.0.layers.0.shortcut.normalization.running_var",
        "resnet.encoder.stages.3.layers.2.layer.1.convolution.weight",
        "classifier.1.bias",
    } < named.keys() and len(named) == 53 * 6 + 2
    weights = load_weights(write(tmp_path / "model.safetensors", named), NARROW)
    assert (weights.naming, weights.stride_in, weights.epsilon) == ("Hugging Face", "3x3", 1e-5)
    for name, array in canonical_arrays().items():
        np.testing.assert_array_equal(weights.arrays[name], array)
    bare = {name.removeprefix("resnet."): array for name, array in named.items() if name.startswith("resnet.")}
    without = load_weights(write(tmp_path / "bare.safetensors", nested(bare, "model.backbone.")), NARROW)
    assert (without.naming, without.classifier) == ("Hugging Face", None)
    np.testing.assert_array_equal(without.arrays["res4f_branch2b/kernel"], weights.arrays["res4f_branch2b/kernel"])


FEATURES = 128
"""Features of NARROW."""

HEADS = {
    "of 10 classes": {"fc.weight": (10, FEATURES), "fc.bias": (10,)},
    "without a bias": {"fc.weight": (1000, FEATURES)},
    "of two layers": {"fc.0.weight": (64, FEATURES), "fc.0.bias": (64,), "fc.2.weight": (5, 64), "fc.2.bias": (5,)},
    "of another name": {"last_linear.weight": (1000, FEATURES), "last_linear.bias": (1000,)},
    "of two sizes": {"fc.weight": (1000, FEATURES), "fc.bias": (10,)},
    "with a norm": {"head.1.weight": (9, FEATURES), "head.0.weight": (FEATURES,), "head.0.running_var": (FEATURES,)},
}


@pytest.mark.parametrize("head", HEADS)
def test_another_head_is_left_out_and_said(tmp_path, head):
    arrays = arrays_in_file(".safetensors", top=False)
    arrays |= {name: np.ones(shape, np.float32) for name, shape in HEADS[head].items()}
    weights = load_weights(write(tmp_path / "a.safetensors", arrays), NARROW)
    assert weights.classifier is None and len(weights.arrays) == 53 * 5
    assert weights.left_out == tuple(f"{name} {list(shape)}" for name, shape in sorted(HEADS[head].items()))
    assert all(name in describe(weights) for name in weights.left_out)


@pytest.mark.parametrize(
    "part",
    [
        {"layer3.6.conv1.weight": (16, 64, 1, 1)},  # of a ResNet101
        {"layer1.0.se.fc1.weight": (4, 16, 1, 1)},  # squeeze and excitation
        {"layer2.0.aa.weight": (4,)},
    ],
    ids=str,
)
def test_parts_of_another_network_are_no_head(tmp_path, part):
    arrays = arrays_in_file(".safetensors") | {name: np.ones(shape, np.float32) for name, shape in part.items()}
    assert f"{next(iter(part))} is unexpected" in refusal(write(tmp_path / "a.safetensors", arrays))


def test_of_several_networks_one_has_to_be_named(tmp_path):
    one, other = arrays_in_file(".pth"), arrays_in_file(".pth", seed=1)
    path = write(tmp_path / "a.pth", nested(one, "module.encoder_q.") | nested(other, "module.encoder_k."))
    assert refusal(path) == (
        "holds 2 networks, whose names begin with 'module.encoder_q.', 'module.encoder_k.': --prefix must say which"
    )
    for prefix, seed in (("module.encoder_q.", 0), ("module.encoder_k", 1)):
        found = load_weights(path, NARROW, prefix=prefix)
        np.testing.assert_array_equal(found.arrays["conv1/kernel"], canonical_arrays(seed=seed)["conv1/kernel"])
    with pytest.raises(InputError, match="no array of a ResNet among its 534 that begin with 'ema.'"):
        load_weights(path, NARROW, prefix="ema.")


def detectron_arrays(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same in the names of detectron2's ResNet, in a detector."""
    named = {}
    for name, array in torchvision_arrays(arrays).items():
        *place, layer, kind = name.replace("downsample.0", "shortcut").replace("downsample.1", "shortcut_bn").split(".")
        if layer != "fc" and kind != "num_batches_tracked":
            block = f"res{int(place[0][5:]) + 1}.{place[1]}" if place else "stem"
            norm = layer.startswith("bn") or layer == "shortcut_bn"
            layer = layer.replace("bn", "conv") if layer.startswith("bn") else layer.removesuffix("_bn")
            named[f"model.backbone.bottom_up.{block}.{layer}{'.norm' if norm else ''}.{kind}"] = array
    return named | {"model.backbone.fpn_lateral2.weight": np.ones((8, 16, 1, 1), np.float32)}


def test_names_of_detectron2(tmp_path):
    theirs = detectron_arrays(caffe_arrays_by_canonical_name())
    assert {
        "model.backbone.bottom_up.stem.conv1.norm.running_mean",
        "model.backbone.bottom_up.res2.0.shortcut.weight",
        "model.backbone.bottom_up.res4.5.conv2.norm.weight",
    } < theirs.keys() and len(theirs) == 53 * 5 + 1
    weights = load_weights(write(tmp_path / "a.pth", theirs), NARROW)
    assert (weights.naming, weights.stride_in, weights.input) == ("Detectron2", "1x1", "caffe")
    assert weights.left_out == ("model.backbone.fpn_lateral2.weight [8, 16, 1, 1]",)
    for name, array in canonical_arrays(top=False).items():
        np.testing.assert_allclose(weights.arrays[name], array, rtol=1e-6)


def caffe_arrays_by_canonical_name() -> dict[str, np.ndarray]:
    """Arrays whose first kernel takes B, G, R from 0 to 255."""
    arrays = canonical_arrays(top=False)
    kernel = (arrays["conv1/kernel"] / (255 * STD)[:, None]).astype(np.float32)
    return arrays | {"conv1/kernel": np.ascontiguousarray(kernel[:, :, ::-1])}


def test_a_few_names_of_a_network_do_not_make_several(tmp_path):
    names = [f"{block}.conv{number}.weight" for block in ("first", "second") for number in (1, 2)]
    message = refusal(write(tmp_path / "a.safetensors", {name: np.ones(3, np.float32) for name in names}))
    assert message.startswith("26") and " of torchvision naming wrong" in message and " is missing" in message


def test_arrays_of_the_other_byte_order_and_of_bfloat16(tmp_path):
    arrays = canonical_arrays()
    large = load_weights(
        write(tmp_path / "a.npz", {n: a.astype(a.dtype.newbyteorder(">")) for n, a in arrays.items()}), NARROW
    )
    short = load_weights(write(tmp_path / "b.npz", {n: a.astype(jnp.bfloat16) for n, a in arrays.items()}), NARROW)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        for name, array in keras_arrays(arrays).items():
            file.create_dataset(f"{name.split('/')[0]}/{name}:0", data=array, dtype=">f8")
    double = load_weights(tmp_path / "c.h5", NARROW)
    for name in arrays.keys() - {"conv1/kernel"}:
        np.testing.assert_array_equal(large.arrays[name], arrays[name])
        np.testing.assert_array_equal(double.arrays[name], arrays[name])
        np.testing.assert_array_equal(short.arrays[name], arrays[name].astype(jnp.bfloat16).astype(np.float32))


# What pixels they are made for


def pixels_of(name: str, images: np.ndarray) -> np.ndarray:
    """What (x / 255 - mean) / std is in the units and the order of the colours of another network."""
    x = images * STD + MEAN
    bgr = lambda pixels: pixels[..., ::-1]
    return {
        "torch": images,
        "torch-bgr": bgr(images),
        "caffe": bgr(255 * (x - MEAN)),
        "caffe-rgb": 255 * (x - MEAN),
        "tf": 2 * x - 1,
        "unit": x,
    }[name]


@pytest.mark.parametrize("name", INPUTS)
def test_weights_for_any_input_are_converted(tmp_path, name):
    """Away from the border, where the padding stands for another colour."""
    arrays = torchvision_arrays(canonical_arrays())
    arrays["conv1.weight"] = arrays["conv1.weight"] / np.abs(pixels_of(name, normalised())).std().astype(np.float32)
    path = write(tmp_path / "a.safetensors", arrays)
    weights = load_weights(path, NARROW, input=name, stride_in="1x1")
    assert (weights.input, weights.stride_in) == (name, "1x1")
    assert weights.origin == "a.safetensors, torchvision names" + (f", input {name}" if name != "torch" else "")
    wanted = torch_stages(arrays, pixels_of(name, normalised()), v1_5=False)
    features, stages = run(weights, normalised(), width=4)
    inside = np.s_[:, 2:-2, 2:-2]
    assert_close(stages["stem"][inside], wanted["stem"][inside])
    if name not in ("tf", "unit"):
        assert_close(features, wanted["features"])
    save_safetensors(weights, tmp_path / "b.safetensors")
    again = load_weights(tmp_path / "b.safetensors", NARROW)
    np.testing.assert_array_equal(again.arrays["conv1/kernel"], weights.arrays["conv1/kernel"])


def caffe_arrays(folded: bool) -> dict[str, np.ndarray]:
    """Weights for B, G, R from 0 to 255 in torchvision's names, with statistics, or folded into gamma and beta."""
    arrays = torchvision_arrays(canonical_arrays())
    arrays["conv1.weight"] = arrays["conv1.weight"][:, ::-1] / np.float32(58.4)
    for name in [name for name in arrays if folded and name.endswith("running_var")]:
        arrays[name], arrays[name.replace("var", "mean")] = np.ones_like(arrays[name]), np.zeros_like(arrays[name])
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}


@pytest.mark.parametrize("prefix", ["", "state_dict.backbone."])
@pytest.mark.parametrize("folded", [True, False])
def test_weights_made_from_caffe_are_refused_unless_they_are_said_to_be(tmp_path, folded, prefix):
    path = write(tmp_path / "a.safetensors", nested(caffe_arrays(folded), prefix))
    message = refusal(path)
    if folded:
        assert message.startswith(f"{prefix}bn1.running_mean = 0 and {prefix}bn1.running_var = 1, as in all 53 norms: ")
    else:
        assert message.startswith(f"{prefix}bn1.running_var = ") and f"squares of {prefix}conv1.weight" in message
    assert "travjax weights --from FILE --input caffe --stride-in 1x1" in message
    with pytest.raises(InputError, match="stride_in = None: must be 1x1, as in most of Caffe's, or 3x3: --stride-in"):
        load_weights(path, NARROW, input="caffe")
    weights = load_weights(path, NARROW, input="caffe", stride_in="1x1")
    wanted = torch_stages(caffe_arrays(folded), pixels_of("caffe", normalised()), v1_5=False)
    assert_close(run(weights, normalised(), width=4)[0], wanted["features"])
    if folded:  # nothing of the numbers speaks against it
        assert load_weights(path, NARROW, input="torch").arrays["conv1/kernel"].std() < 0.01
    else:
        with pytest.raises(InputError, match="made for larger values; travjax weights --from FILE --input caffe"):
            load_weights(path, NARROW, input="torch")


def test_an_input_that_the_numbers_speak_against_is_not_believed(tmp_path):
    path = write(tmp_path / "a.safetensors", torchvision_arrays(canonical_arrays()))
    load_weights(path, NARROW, input="torch")
    with pytest.raises(InputError, match="made for smaller values; .* --input torch takes them as what they are"):
        load_weights(path, NARROW, input="caffe", stride_in="1x1")


def test_a_first_kernel_of_zeros_or_of_no_usual_size_is_refused(tmp_path):
    for factor, reason in (
        (0, "^conv1.weight = 0 throughout: must be the kernel of a network$"),
        (1e6, "; there is no --input that it would fit$"),
    ):
        arrays = canonical_arrays()
        arrays["conv1/kernel"] = arrays["conv1/kernel"] * np.float32(factor)
        assert re.search(reason, refusal(write(tmp_path / "a.safetensors", torchvision_arrays(arrays))))


@pytest.mark.parametrize("told", [None, "torch"])
@pytest.mark.parametrize("fresh", [{}, {"gamma": 1, "var": 1}])
def test_weights_of_zeros_are_refused(tmp_path, fresh, told):
    """Neither measured nor, with statistics of 0 and 1, a network before training."""
    zeros = {name: np.full_like(array, fresh.get(name.split("/")[1], 0)) for name, array in canonical_arrays().items()}
    path = write(tmp_path / "a.safetensors", torchvision_arrays(zeros))
    with pytest.raises(InputError, match="conv1.weight = 0 throughout: must be the kernel of a network$"):
        load_weights(path, NARROW, input=told)


def test_weights_of_keras_for_small_pixels_are_refused(tmp_path):
    arrays = keras_arrays(canonical_arrays())
    arrays["conv1_conv/kernel"] *= PIXELS
    path = write(tmp_path / "a.h5", arrays)
    message = refusal(path)
    assert message.startswith("conv1_bn/moving_variance = ") and "made for smaller values; " in message
    assert "--input torch takes them as what they are (or torch-bgr or tf or unit)" in message
    wanted = canonical_arrays()["conv1/kernel"]
    np.testing.assert_array_equal(load_weights(path, NARROW, input="torch").arrays["conv1/kernel"], wanted)


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".safetensors"])
def test_weights_of_a_network_before_training_are_read(tmp_path, suffix):
    arrays = canonical_arrays()
    fresh = {"gamma": 1, "beta": 0, "mean": 0, "var": 1}
    for name in [name for name in arrays if not name.startswith("fc1000") and name.split("/")[1] in fresh]:
        arrays[name] = np.full_like(arrays[name], fresh[name.split("/")[1]])
    arrays["res3b_branch2c/gamma"][:] = 0  # as some begin
    named = {".npz": lambda a: a, ".h5": keras_arrays, ".safetensors": torchvision_arrays}[suffix](arrays)
    weights = load_weights(write(tmp_path / f"a{suffix}", named), NARROW)
    np.testing.assert_array_equal(weights.arrays["res4f_branch2b/kernel"], arrays["res4f_branch2b/kernel"])
    assert re.search("^statistics +0 and 1: a network before training$", describe(weights), re.MULTILINE)


def test_what_a_converted_file_is_made_for_is_not_said_again(tmp_path):
    weights = load_weights(
        write(tmp_path / "a.safetensors", caffe_arrays(True)), NARROW, input="caffe", stride_in="1x1"
    )
    save_safetensors(weights, tmp_path / "b.safetensors")
    again = load_weights(tmp_path / "b.safetensors", NARROW)
    assert re.search("^statistics +0 and 1: none, gamma and beta hold them$", describe(again), re.MULTILINE)
    assert (again.stride_in, again.origin) == ("1x1", "a.safetensors, torchvision names, input caffe")
    for told in ({"input": "caffe"}, {"stride_in": "3x3"}):
        with pytest.raises(InputError, match=f"{next(iter(told))} = '.*': must be "):
            load_weights(tmp_path / "b.safetensors", NARROW, **told)


@pytest.mark.parametrize(
    ("told", "wrong"),
    [({"input": "bgr"}, "input = 'bgr': must be one of torch"), ({"stride_in": "2x2"}, "stride_in = '2x2': must be")],
)
def test_what_weights_cannot_be_made_for_is_refused(tmp_path, told, wrong):
    path = write(tmp_path / "a.safetensors", torchvision_arrays(canonical_arrays()))
    with pytest.raises(InputError, match=wrong):
        load_weights(path, NARROW, **told)


def test_converted_weights_that_were_damaged_are_refused(tmp_path):
    weights = load_weights(write(tmp_path / "a.npz", canonical_arrays()), NARROW)
    path = tmp_path / "b.safetensors"
    save_safetensors(weights, path)
    damaged = bytearray(path.read_bytes())
    damaged[-1000] ^= 1
    path.write_bytes(damaged)
    assert re.search(r"^the SHA-256 of \S+ is not the one that the file gives: the file is damaged$", refusal(path))


# Our .npz


def shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"needs {path} (TRAVJAX_DATA is the folder above)")
    return path


def test_our_weights_compute_the_recorded_activations():
    weights = load_weights(shared("resnet50_imagenet.npz"))
    with np.load(shared("resnet50_check.npz")) as file:
        check = dict(file)
    features, stages = run(weights, ((check["images"] / 255 - MEAN) / STD).astype(np.float32))
    assert stages.keys() == {"stem", "stage2", "stage3", "stage4", "stage5"}
    for name, stage in stages.items():
        assert_close(np.asarray(stage).mean((1, 2)), check[name])
    kernel, bias = weights.classifier
    assert_close(features @ kernel + bias, check["logits"])


def test_our_weights_are_described():
    weights = load_weights(shared("resnet50_imagenet.npz"))
    assert sum((weights.arrays[name] == 0).all() for name in weights.arrays if name.endswith("gamma")) == 0
    dead = sum(int((array == 0).sum()) for name, array in weights.arrays.items() if name.endswith("/gamma"))
    assert dead == 763  # README of the data
    rows = dict(line.split("  ", 1) for line in describe(weights).splitlines())
    rows = {key.strip(): value.strip() for key, value in rows.items()}
    assert rows["arrays"] == "267"
    assert rows["zeros in kernels"] == "81.5%"
    assert rows["top layer"] == "1000 classes"
    assert rows["strides"] == "in the 1x1 convolutions (v1)"
    assert rows["batch-norm epsilon"] == "1e-05"
    assert rows["statistics"] == "measured"
    assert rows["left out"] == "nothing"
    assert rows["made for"] == rows["input"] == "R, G, B, (x / 255 - mean) / std"


# Weights into a network


@pytest.mark.parametrize("epsilon", [1e-7, 1e-3])
def test_another_epsilon_of_the_network_leaves_its_function(tmp_path, epsilon):
    arrays = canonical_arrays()
    random = np.random.default_rng(2)
    for name in [name for name in arrays if name.endswith("/var")]:
        small = random.random(arrays[name].shape) < 0.3
        arrays[name][small] *= 1e-6  # where epsilon dominates
        arrays[name.replace("/var", "/gamma")][small] *= 1e-3
        arrays[name.replace("/var", "/gamma")][:1] = 0  # a dead channel
    weights = load_weights(write(tmp_path / "a.npz", arrays), NARROW)
    wanted = torch_stages(torchvision_arrays(arrays), normalised(), v1_5=False)
    assert_close(run(weights, normalised(), width=4, epsilon=epsilon)[0], wanted["features"])


def test_applied_weights_are_parameters_and_statistics_of_their_names(tmp_path):
    arrays = canonical_arrays()
    resnet = nnx.eval_shape(lambda: ResNet(NARROW, rngs=nnx.Rngs(0)))
    apply_weights(resnet, load_weights(write(tmp_path / "a.npz", arrays), NARROW))
    np.testing.assert_array_equal(resnet.conv1.kernel[...], arrays["conv1/kernel"])
    np.testing.assert_array_equal(resnet.res4f.branch2c.scale[...], arrays["res4f_branch2c/gamma"])
    np.testing.assert_array_equal(resnet.res3a.branch1.bias[...], arrays["res3a_branch1/beta"])
    np.testing.assert_array_equal(resnet.res5c.branch2b.mean[...], arrays["res5c_branch2b/mean"])
    np.testing.assert_array_equal(resnet.res5c.branch2b.var[...], arrays["res5c_branch2b/var"])


def test_weights_of_another_size_or_stride_are_refused_and_nothing_is_set(tmp_path):
    weights = load_weights(write(tmp_path / "a.npz", canonical_arrays()), NARROW)
    for wrong, message in (
        (replace(NARROW, stride_in="3x3"), "stride_in = '3x3': must be \"1x1\", as in the network of these weights"),
        (replace(NARROW, width=8), "config = .* width 8': must be of the size of these weights"),
        (replace(NARROW, blocks=(1,)), r"config = .*\(1,\)"),
    ):
        resnet = nnx.eval_shape(lambda: ResNet(wrong, rngs=nnx.Rngs(0)))  # noqa: B023
        with pytest.raises(InputError, match=message):
            apply_weights(resnet, weights)
        assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(nnx.state(resnet)))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("top", [True, False])
def test_saved_weights_are_read_back_equal(tmp_path, suffix, top):
    weights = load_weights(write(tmp_path / f"a{suffix}", arrays_in_file(suffix, top=top)), NARROW)
    save_safetensors(weights, tmp_path / "b.safetensors")
    again = load_weights(tmp_path / "b.safetensors", NARROW)
    assert (again.stride_in, again.epsilon, again.origin) == (weights.stride_in, weights.epsilon, weights.origin)
    assert again.origin.startswith(f"a{suffix}, ") and again.naming == "canonical"
    assert again.arrays.keys() == weights.arrays.keys() == canonical_arrays(top=top).keys()
    for name, array in weights.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)
    assert f"{len(weights.arrays)}" in describe(again) and weights.origin in describe(again)


def test_weights_that_cannot_be_saved_leave_nothing(tmp_path):
    weights = load_weights(write(tmp_path / "a.npz", canonical_arrays()), NARROW)
    (tmp_path / "b.safetensors").mkdir()
    with pytest.raises(InputError, match="b.safetensors: cannot be written"):
        save_safetensors(weights, tmp_path / "b.safetensors")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.safetensors"]


# Wrong files


def refusal(path: Path, config: ResNetConfig = NARROW) -> str:
    """The error for a file, which is one line and names it."""
    with pytest.raises(InputError) as error:
        load_weights(path, config)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


FIRST = {".npz": "conv1/kernel", ".h5": "conv1_conv/kernel", ".safetensors": "conv1.weight", ".pth": "conv1.weight"}
SOME = {
    ".npz": ["res2a_branch1/gamma", "res3b_branch2a/mean", "res4f_branch2c/var", "fc1000/bias"],
    ".h5": [
        "conv2_block1_0_bn/gamma",
        "conv3_block2_1_conv/bias",
        "conv4_block6_3_bn/moving_variance",
        "predictions/bias",
    ],
    ".safetensors": [
        "layer1.0.downsample.1.weight",
        "layer2.1.bn1.running_mean",
        "layer3.5.bn3.running_var",
        "fc.bias",
    ],
}
SOME[".pth"] = SOME[".safetensors"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_all_mismatches_are_named_in_one_error_by_the_names_of_the_file(tmp_path, suffix):
    arrays = arrays_in_file(suffix)
    missing, shaped, negative_or_infinite, counted = SOME[suffix]
    arrays.pop(missing)
    arrays[shaped] = arrays[shaped][:-1]
    arrays[negative_or_infinite] = np.full_like(arrays[negative_or_infinite], -1)
    arrays[counted] = arrays[counted].astype(np.int32)
    arrays[FIRST[suffix]][0, 0, 0, 0] = np.nan
    arrays["another/layer"] = np.zeros(3, np.float32)
    message = refusal(write(tmp_path / f"a{suffix}", arrays))
    assert message.startswith("6 arrays of ")
    for wrong in (
        f"{missing} is missing",
        "another/layer is unexpected",
        f"{shaped} is [7], not [8]",
        f"{negative_or_infinite} is negative somewhere",
        f"{counted} is int32, not floating-point",
        f"{FIRST[suffix]} is not finite throughout",
    ):
        assert wrong in message


def test_of_many_mismatches_the_first_are_named_and_the_others_counted(tmp_path):
    arrays = canonical_arrays()
    lost = [name for name in arrays if name.startswith("res4")]
    path = write(tmp_path / "a.npz", {name: array for name, array in arrays.items() if name not in lost})
    message = refusal(path)
    assert message.startswith(f"{len(lost)} arrays ") and message.endswith(f"; and {len(lost) - 6} more")
    assert message.count("is missing") == 6


def test_kernels_in_the_layout_of_another_framework_are_refused(tmp_path):
    arrays = torchvision_arrays(canonical_arrays())
    arrays["layer1.0.conv2.weight"] = arrays["layer1.0.conv1.weight"].transpose(2, 3, 1, 0)
    assert "layer1.0.conv2.weight is [1, 1, 4, 4], not [4, 4, 3, 3]" in refusal(
        write(tmp_path / "a.safetensors", arrays)
    )


def test_a_float64_beyond_float32_is_not_finite(tmp_path):
    arrays = canonical_arrays() | {"res2a_branch1/beta": np.full(16, 1e300)}
    assert "res2a_branch1/beta is not finite" in refusal(write(tmp_path / "a.npz", arrays))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_resnet_of_another_size_is_refused(tmp_path, suffix):
    message = refusal(write(tmp_path / f"a{suffix}", arrays_in_file(suffix)), ResNetConfig())
    assert f"{FIRST[suffix]} is " in message and "more" in message


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_arrays_of_another_network_are_refused(tmp_path, suffix):
    message = refusal(write(tmp_path / f"a{suffix}", {"block1/filter": np.ones(3, np.float32)}))
    assert message.startswith("no array of a ResNet among its 1; allowed names") and "conv1.weight" in message


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.999])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_truncated_file_is_refused(tmp_path, suffix, kept):
    path = write(tmp_path / f"a{suffix}", arrays_in_file(suffix, top=False))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    message = refusal(path)
    if kept == 0:
        assert message == "is empty: must be a file of weights"
        return
    assert message.startswith((f"cannot be read as {suffix}, damaged or something else: ", "holds pickled code, which"))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"<html>404 not found</html>\n" * 40, "is an HTML page: must be a file of weights; "),
        (b"\xef\xbb\xbf\n<!DOCTYPE html>\n<title>Sign in</title>", "is an HTML page: must be a file of weights; "),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:12ab\nsize 9\n", "is a Git LFS pointer: must be "),
        (b"Of mountains & rivers\n" * 40, ""),
    ],
    ids=["page", "login", "pointer", "text"],
)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_of_something_else_is_refused(tmp_path, suffix, content, reason):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    assert refusal(path).startswith(reason)


def test_bits_that_turned_over_in_an_npz_are_noticed(tmp_path):
    path = write(tmp_path / "a.npz", canonical_arrays())
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(bytes(damaged))
    assert "cannot be read as .npz" in refusal(path)


class Malicious:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("how", ["torch.save", "pickle 2", "pickle 4", "npz"])
def test_pickled_code_is_not_run(tmp_path, how):
    torch = pytest.importorskip("torch")
    mark, path = tmp_path / "ran", tmp_path / "a.pth"
    state = torchvision_arrays(canonical_arrays()) | {"conv1.weight": Malicious(mark)}
    if how == "torch.save":
        torch.save(state, path)
    elif how == "npz":
        path = tmp_path / "a.npz"
        np.savez(path, **canonical_arrays() | {"conv1/kernel": np.array([Malicious(mark)])})
    else:
        path.write_bytes(pickle.dumps(state, protocol=int(how[-1])))
    message = refusal(path)
    assert "conv1/kernel is object, not" in message if how == "npz" else message.startswith("holds pickled code, which")
    assert not mark.exists()
    pickle.loads(pickle.dumps(Malicious(mark)))
    assert mark.exists()  # it would have


@pytest.mark.parametrize("content", [[1, 2], {"epoch": 3}, {"state_dict": {}}])
def test_a_pth_without_tensors_by_name_is_refused(tmp_path, content):
    torch = pytest.importorskip("torch")
    torch.save(content, tmp_path / "a.pth")
    assert "allowed: a saved state_dict()" in refusal(tmp_path / "a.pth")


def test_a_keras_file_of_two_networks_is_refused(tmp_path):
    path = write(tmp_path / "a.h5", arrays_in_file(".h5"))
    with h5py.File(path, "a") as file:
        file["second/conv1_conv/kernel:0"] = np.ones(3)
    assert "holds conv1_conv/kernel twice" in refusal(path)


@pytest.mark.parametrize(
    ("notes", "wrong"),
    [
        ({"epsilon": -1}, "epsilon = -1: must be"),
        ({"epsilon": "1"}, "epsilon = '1': must be"),
        ({"stride_in": "5x5"}, "stride_in = '5x5': must be"),
        ([3], "cannot be read as .safetensors"),
    ],
)
def test_altered_notes_of_saved_weights_are_refused(tmp_path, notes, wrong):
    save_file(canonical_arrays(), tmp_path / "a.safetensors", metadata={"travjax": json.dumps(notes)})
    assert wrong in refusal(tmp_path / "a.safetensors")


def test_paths_that_are_no_file_of_weights(tmp_path):
    (tmp_path / "a.npz").mkdir()
    assert refusal(tmp_path / "a.npz") == "is a folder; allowed: a file"
    assert refusal(tmp_path / "b.npz") == "no such file"
    assert refusal(tmp_path / "b.onnx") == (
        "unknown kind of file; allowed: .npz, .h5, .hdf5, .keras, .safetensors, .pth, .pt, .bin, .ckpt, .tar"
    )


@pytest.mark.parametrize(("suffix", "library"), [(".h5", "h5py"), (".pth", "torch")])
def test_an_optional_library_that_is_not_there_is_named(tmp_path, monkeypatch, suffix, library):
    path = write(tmp_path / f"a{suffix}", arrays_in_file(suffix, top=False))
    monkeypatch.setitem(sys.modules, library, None)
    assert f"pip install {library}" in refusal(path)


# The hub


def test_fetched_weights_can_be_loaded(tmp_path, monkeypatch):
    path = write(tmp_path / "model.safetensors", arrays_in_file(".safetensors"))
    asked = []
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda *names: asked.append(names) or str(path))
    assert load_weights(fetch("someone/resnet", "model.safetensors"), NARROW).naming == "torchvision"
    assert asked == [("someone/resnet", "model.safetensors")]


def test_a_file_that_cannot_be_fetched_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    for repository in ("someone/resnet", "no such/name/at all"):
        with pytest.raises(InputError, match=f"^{repository}/model.safetensors: cannot be fetched; .*a file") as error:
            fetch(repository, "model.safetensors")
        assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match="pip install huggingface_hub"):
        fetch()


def test_saved_files_are_canonical_safetensors(tmp_path):
    weights = load_weights(write(tmp_path / "a.npz", canonical_arrays()), NARROW)
    save_safetensors(weights, tmp_path / "b.safetensors")
    assert load_file(tmp_path / "b.safetensors").keys() == canonical_arrays().keys()
