"""The trunk against a float64 NumPy network, its statistics, conventions and sizes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from numpy.lib.stride_tricks import sliding_window_view

from travjax.config import InputError
from travjax.resnet.network import ConvNorm, ResNet, ResNetConfig

NARROW = ResNetConfig(blocks=(2, 1, 1), width=4)
MODES = [False, True]


def network(config: ResNetConfig = NARROW, seed: int = 0) -> ResNet:
    """A network whose parameters and statistics are all random."""
    resnet = nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(0)))
    random = np.random.default_rng(seed)
    for path, variable in nnx.iter_graph(resnet):
        if isinstance(variable, nnx.Variable):
            kind, shape = path[-1], variable.shape
            if kind == "kernel":
                array = random.standard_normal(shape) * np.sqrt(2 / np.prod(shape[:-1]))
            else:
                array = random.uniform(*{"scale": (0.5, 1.5), "var": (0.3, 2)}.get(kind, (-0.5, 0.5)), shape)
            variable.set_value(jnp.asarray(array, jnp.float32))
    return resnet


def pictures(size: int = 33, count: int = 3, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, size, size, 3)).astype(np.float32)


def arrays_of(resnet: ResNet, kind=nnx.Variable) -> dict[str, np.ndarray]:
    """Copies of parameters or statistics, by path."""
    nodes = {".".join(map(str, path)): node for path, node in nnx.iter_graph(resnet) if isinstance(node, kind)}
    return {path: np.array(node[...]) for path, node in nodes.items()}


class Float64:
    """The same network in plain float64 NumPy; `batch` collects the statistics of the batch."""

    def __init__(self, resnet: ResNet, train: bool):
        self.arrays = {path: array.astype(np.float64) for path, array in arrays_of(resnet).items()}
        self.config, self.train, self.batch = resnet.config, train, {}

    def convolution(self, x, name: str, stride: int):
        kernel, scale, bias, mean, var = (
            self.arrays[f"{name}.{a}"] for a in ("kernel", "scale", "bias", "mean", "var")
        )
        size = len(kernel)
        edge = (size // 2, size // 2)
        windows = sliding_window_view(np.pad(x, ((0, 0), edge, edge, (0, 0))), (size, size), axis=(1, 2))
        y = np.einsum("brcihw,hwio->brco", windows[:, ::stride, ::stride], kernel)
        if self.train:
            mean, var = self.batch[name] = y.mean((0, 1, 2)), y.var((0, 1, 2))
        return scale * (y - mean) / np.sqrt(var + self.config.epsilon) + bias

    def block(self, x, name: str, stride: int):
        strides = (stride, 1) if self.config.stride_in == "1x1" else (1, stride)
        y = np.maximum(self.convolution(x, f"{name}.branch2a", strides[0]), 0)
        y = np.maximum(self.convolution(y, f"{name}.branch2b", strides[1]), 0)
        if f"{name}.branch1.kernel" in self.arrays:
            x = self.convolution(x, f"{name}.branch1", stride)
        return np.maximum(x + self.convolution(y, f"{name}.branch2c", 1), 0)

    def __call__(self, images):
        x = np.maximum(self.convolution(images.astype(np.float64), "conv1", 2), 0)
        x = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=-np.inf)
        x = sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max((-1, -2))
        stages = {"stem": x}
        for stage, blocks in enumerate(self.config.blocks, start=2):
            for block in range(blocks):
                x = self.block(x, f"res{stage}{'abcdef'[block]}", 2 if stage > 2 and block == 0 else 1)
            stages[f"stage{stage}"] = x
        return x.mean((1, 2)), stages


def assert_close(found, wanted, rtol: float = 1e-5):
    """To a share of the largest value."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=rtol * np.abs(wanted).max())


@pytest.mark.parametrize("train", MODES)
@pytest.mark.parametrize("stride_in", ["1x1", "3x3"])
@pytest.mark.parametrize("size", [33, 40])
def test_every_stage_agrees_with_float64(size, stride_in, train):
    resnet = network(replace(NARROW, stride_in=stride_in))
    wanted_features, wanted = Float64(resnet, train)(pictures(size))
    features, stages = resnet(pictures(size), train=train)
    assert list(stages) == list(wanted) == ["stem", "stage2", "stage3", "stage4"]
    for name, stage in stages.items():
        assert_close(stage, wanted[name])
    assert_close(features, wanted_features)


@pytest.mark.parametrize("momentum", [0.99, 0.9, 0.3])
def test_training_moves_statistics_towards_those_of_the_batch(momentum):
    resnet = network(replace(NARROW, momentum=momentum))
    before, oracle = arrays_of(resnet, nnx.BatchStat), Float64(resnet, train=True)
    oracle(pictures())
    resnet(pictures(), train=True)
    after = arrays_of(resnet, nnx.BatchStat)
    assert len(after) == 2 * len(oracle.batch) == 2 * 16
    for name, (mean, var) in oracle.batch.items():
        for array, of_batch in (("mean", mean), ("var", var)):
            wanted = momentum * before[f"{name}.{array}"] + (1 - momentum) * of_batch
            assert_close(after[f"{name}.{array}"], wanted)


def test_training_changes_no_parameter_and_inference_nothing():
    resnet = network()
    parameters, everything = arrays_of(resnet, nnx.Param), arrays_of(resnet)
    resnet(pictures())
    for name, array in arrays_of(resnet).items():
        np.testing.assert_array_equal(array, everything[name])
    resnet(pictures(), train=True)
    for name, array in arrays_of(resnet, nnx.Param).items():
        np.testing.assert_array_equal(array, parameters[name])


def test_output_in_training_does_not_depend_on_the_running_statistics():
    resnet, other = network(), network()
    for _, node in nnx.iter_graph(other):
        if isinstance(node, nnx.BatchStat):
            node[...] = node[...] + 3
    np.testing.assert_array_equal(resnet(pictures(), train=True)[0], other(pictures(), train=True)[0])


def test_output_does_not_depend_on_the_batch_at_inference():
    resnet = network()
    together = resnet(pictures())[0]
    alone = jnp.concatenate([resnet(picture[None])[0] for picture in pictures()])
    assert_close(together, alone)


def test_bfloat16_activations_keep_float32_parameters_and_statistics():
    resnet, exact = network(replace(NARROW, dtype="bfloat16")), network()
    features, stages = resnet(pictures(), train=True)
    wanted = exact(pictures(), train=True)[0]
    assert features.dtype == jnp.float32
    assert {stage.dtype for stage in stages.values()} == {jnp.dtype(jnp.bfloat16)}
    assert {array.dtype for array in arrays_of(resnet).values()} == {np.dtype(np.float32)}
    assert_close(features, wanted, rtol=0.05)
    for name, array in arrays_of(exact, nnx.BatchStat).items():
        assert_close(arrays_of(resnet)[name], array, rtol=0.02)


def test_strides_of_v1_and_v1_5_are_in_different_convolutions():
    v1, later = (network(replace(NARROW, stride_in=stride_in)) for stride_in in ("1x1", "3x3"))
    strides = lambda block: (block.branch2a.stride, block.branch2b.stride, block.branch2c.stride, block.branch1.stride)
    assert strides(v1.res3a) == (2, 1, 1, 2) and strides(later.res3a) == (1, 2, 1, 2)
    assert strides(v1.res2a) == strides(later.res2a) == (1, 1, 1, 1)
    features, others = v1(pictures())[0], later(pictures())[0]
    assert features.shape == others.shape
    assert np.abs(features - others).max() > 0.01 * np.abs(features).max()


def test_mirrored_kernels_see_mirrored_images_alike():
    """On odd sizes, where symmetric padding is symmetric at every stride: 65, 33, 17, 9, 5."""
    resnet, mirrored = network(), network()
    for path, node in nnx.iter_graph(mirrored):
        if isinstance(node, nnx.Variable) and path[-1] == "kernel":
            node[...] = node[...][:, ::-1]
    stages, others = resnet(pictures(65))[1], mirrored(pictures(65)[:, :, ::-1])[1]
    for name in stages:
        assert_close(others[name][:, :, ::-1], stages[name])


def test_resnet50_has_the_sizes_of_the_paper():
    resnet = nnx.eval_shape(lambda: ResNet(rngs=nnx.Rngs(0)))
    count = lambda kind: sum(node.size for _, node in nnx.iter_graph(resnet) if isinstance(node, kind))
    assert count(nnx.Param) == 25_557_032 - 2048 * 1000 - 1000  # torchvision's, without its classifier
    assert count(nnx.BatchStat) == 53_120
    blocks = {path[0] for path, _ in nnx.iter_graph(resnet) if path and str(path[0]).startswith("res")}
    names = {2: "abc", 3: "abcd", 4: "abcdef", 5: "abc"}
    assert blocks == {f"res{stage}{letter}" for stage, letters in names.items() for letter in letters}
    features, stages = jax.eval_shape(lambda: ResNet(rngs=nnx.Rngs(0))(jnp.zeros((2, 129, 129, 3))))
    shapes = {name: stage.shape[1:] for name, stage in stages.items()}
    wanted = {"stem": (33, 33, 64), "stage2": (33, 33, 256), "stage3": (17, 17, 512), "stage4": (9, 9, 1024)}
    assert shapes == wanted | {"stage5": (5, 5, 2048)}
    assert features.shape == (2, ResNetConfig().features) == (2, 2048)


def test_kernels_start_normal_with_the_variance_of_he():
    kernel = np.asarray(ConvNorm(64, 128, 3, 1, ResNetConfig(), rngs=nnx.Rngs(0)).kernel[...])
    assert kernel.std() == pytest.approx(np.sqrt(2 / (9 * 128)), rel=0.02)
    assert abs(kernel.mean()) < 1e-3
    assert np.abs(kernel).max() > 4 * kernel.std()  # not cut off


def test_kernels_of_different_layers_and_seeds_differ():
    small = ResNetConfig(blocks=(2,), width=4)
    one, two = (ResNet(small, rngs=nnx.Rngs(seed)) for seed in (0, 1))
    assert not np.array_equal(one.res2a.branch2a.kernel[...], two.res2a.branch2a.kernel[...])
    assert not np.array_equal(one.res2a.branch2c.kernel[...], one.res2b.branch2c.kernel[...])


def test_every_parameter_has_a_gradient_in_a_jitted_step():
    resnet = network()
    graph, parameters, rest = nnx.split(resnet, nnx.Param, ...)

    @jax.jit
    def step(parameters, rest):
        def loss(parameters):
            model = nnx.merge(graph, parameters, rest, copy=True)
            features = model(pictures(), train=True)[0]
            return jnp.square(features - jnp.arange(features.shape[1])).mean(), nnx.state(model, nnx.BatchStat)

        return jax.grad(loss, has_aux=True)(parameters)

    gradients, statistics = step(parameters, rest)
    for gradient in jax.tree.leaves(gradients):
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0
    moved = [not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (statistics, rest)), strict=True)]
    assert all(moved)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("blocks", ()),
        ("blocks", [3, 4]),
        ("blocks", (3, 0)),
        ("blocks", (27,)),
        ("blocks", (1.0,)),
        ("blocks", (1,) * 9),
        ("width", 0),
        ("width", 6.4),
        ("width", True),
        ("stride_in", "v1"),
        ("epsilon", 0.0),
        ("epsilon", float("nan")),
        ("momentum", 1.5),
        ("momentum", "0.9"),
        ("dtype", "float16"),
    ],
)
def test_a_bad_configuration_names_field_value_and_what_is_allowed(field, value):
    with pytest.raises(InputError, match=f"^{field} = .*: must be ") as error:
        ResNetConfig(**{field: value})
    assert repr(value) in str(error.value)
