"""Devices hold, cut and give back arrays alike, whether one, several of a process or those of two processes."""

import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from travjax.config import InputError
from travjax.devices import Devices, join

TREE = {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3), "rest": [np.array([3, 1], np.uint8), np.float32(2.5)]}

COMMON = """
import sys, jax, jax.numpy as jnp, numpy as np
from travjax.config import InputError
from travjax.devices import Devices, join
coordinator, processes, process = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if processes > 1:
    join(coordinator, processes, process)
devices = Devices.all()
assert jax.process_count() == processes and jax.device_count() == devices.mesh.size == 4
assert devices.main == (process == 0)

images = np.random.default_rng(0).standard_normal((8, 3, 5)).astype(np.float32)
kernel = np.random.default_rng(1).standard_normal((5, 2)).astype(np.float32)
part, whole = devices.shard({"images": images}), devices.replicate([kernel, np.float32(2)])
local = part["images"].addressable_shards
assert len(local) == 4 // processes and all(shard.data.shape == (2, 3, 5) for shard in local)
for shard in local:
    np.testing.assert_array_equal(shard.data, images[shard.index])
for array, host in zip(whole, (kernel, np.float32(2))):
    assert array.sharding.is_fully_replicated
    np.testing.assert_array_equal(devices.fetch(array), host)
fetched = devices.fetch(part["images"])
assert type(fetched) is np.ndarray and fetched.dtype == np.float32
np.testing.assert_array_equal(fetched, images)


def step(kernel, factor, images):
    def loss(kernel):
        pixels = images.reshape(-1, 5) @ kernel * factor
        return jnp.square(pixels - pixels.mean(0)).mean(), pixels.reshape(8, 3, 2)

    return jax.value_and_grad(loss, has_aux=True)(kernel)


(value, pixels), gradient = jax.jit(step)(*whole, part["images"])
host = images.reshape(-1, 5).astype(np.float64) @ kernel * 2
centred = host - host.mean(0)
np.testing.assert_allclose(devices.fetch(value), np.square(centred).mean(), rtol=1e-5)
np.testing.assert_allclose(devices.fetch(pixels), host.reshape(8, 3, 2), rtol=1e-4, atol=1e-4)
wanted = 2 * images.reshape(-1, 5).T @ centred * 2 / centred.size
np.testing.assert_allclose(devices.fetch(gradient), wanted, rtol=1e-4, atol=1e-4)

devices.check_batch(8)
try:
    devices.check_batch(6)
except InputError as error:
    print(error)
"""


def started(processes: int, process: int, coordinator: str) -> subprocess.Popen:
    flag = f"--xla_force_host_platform_device_count={4 // processes}"
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flag}
    command = [sys.executable, "-W", "error", "-c", COMMON, coordinator, str(processes), str(process)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


# One device


def test_arrays_come_back_as_they_were():
    devices = Devices.all()
    assert devices.main
    for placed in (devices.replicate(TREE), devices.shard(TREE["kernel"])):
        for array in jax.tree.leaves(placed):
            assert isinstance(array, jax.Array) and array.sharding.mesh == devices.mesh
    back = jax.tree.map(devices.fetch, devices.replicate(TREE))
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(TREE), strict=True):
        assert type(one) is np.ndarray and one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_a_batch_can_be_summed_over_under_jit():
    devices = Devices.all()
    images, kernel = np.ones((8, 5), np.float32), np.ones((5, 2), np.float32)
    gradient = jax.jit(jax.grad(lambda kernel, images: jnp.square(images @ kernel).sum()))
    np.testing.assert_array_equal(gradient(devices.replicate(kernel), devices.shard(images)), np.full((5, 2), 80.0))


def test_any_batch_fits_one_device():
    one = Devices(jax.sharding.Mesh(np.array(jax.devices()[:1]), ("batch",)))
    for size in (1, 7, 32):
        one.check_batch(size)


# Several devices and processes


def finished(*processes: subprocess.Popen) -> None:
    """Each process does well and prints the error of a batch that cannot be cut in four."""
    try:
        for process in processes:
            out, err = process.communicate(timeout=60)
            assert process.returncode == 0, err
            assert out.splitlines()[-1:] == ["batch_size = 6: must be a multiple of the 4 devices that share a batch"]
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def test_four_devices_of_one_process_share_a_batch():
    finished(started(1, 0, ""))


def test_two_processes_of_two_devices_share_a_batch():
    coordinator = f"127.0.0.1:{free_port()}"
    finished(started(2, 0, coordinator), started(2, 1, coordinator))


# Bad arguments of join, none of which gets as far as a connection


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("127.0.0.1:1", 0, 0), "--processes = 0: must be at least 1"),
        (("127.0.0.1:1", -2, 0), "--processes = -2: must be at least 1"),
        (("127.0.0.1:1", 2, 2), "--process = 2: must be from 0 to 1"),
        (("127.0.0.1:1", 2, -1), "--process = -1: must be from 0 to 1"),
    ],
)
def test_a_number_of_processes_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(InputError) as error:
        join(*arguments)
    assert str(error.value) == message


@pytest.mark.parametrize("coordinator", ["", "nowhere", "127.0.0.1"])
def test_an_address_without_a_port_is_refused_in_one_line(coordinator):
    program = "import sys; from travjax.devices import join; join(sys.argv[1], 1, 0)"
    done = subprocess.run(
        [sys.executable, "-c", program, coordinator],
        capture_output=True,
        text=True,
        timeout=60,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"travjax.config.InputError: --coordinator = {coordinator!r}: must be address:port")
    assert last.endswith("must be address:port of process 0")
