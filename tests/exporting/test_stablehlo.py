"""StableHLO files: they return what travjax returns, for any number of maps; what they are stands beside them."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import export

from tests.field_runs import RUN, estimator
from tests.small_training import SETUP, dataset
from tests.small_training import run_of as resnet_run
from travjax.config import InputError
from travjax.exporting import exported_file
from travjax.exporting.stablehlo import PLATFORMS, export_field, export_simulator
from travjax.files import sha256
from travjax.runs.predictor import Predictor
from travjax.simulation.actions import ActionSpace
from travjax.simulation.contact import Contact
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import failures, margins_of

pytestmark = pytest.mark.usefixtures("shared_code")

TINY = Predictor(RUN, estimator())
SHORT = ActionSpace(turns=2, arc_lengths=(0.2, 0.2), radii=(math.inf,), interval=0.2)
"""Few poses, since code is compiled for each."""


def loaded(path: Path) -> export.Exported:
    return export.deserialize(bytearray(path.read_bytes()))


def described(path: Path) -> dict:
    return json.loads(Path(f"{path}.json").read_text())


@pytest.fixture(scope="module")
def heights() -> np.ndarray:
    """Three maps: a known one, one with a hole ahead of the robot, and one that is unknown in its middle."""
    maps = dataset().heights[:3].copy()
    maps[1, 23:25, 14:19] = np.nan
    maps[2, 14:19, 14:19] = np.nan
    return maps


@pytest.fixture(scope="module")
def field_file(tmp_path_factory) -> Path:
    return export_field(tmp_path_factory.mktemp("exported") / "tiny.stablehlo", TINY)[0]


@pytest.fixture(scope="module")
def function(field_file) -> Callable:
    """What the file of a field computes, compiled."""
    return jax.jit(loaded(field_file).call)


def test_a_field_predicts_as_its_predictor_does(function, heights):
    found, wanted = function(heights), TINY.predict(heights)
    np.testing.assert_allclose(found["probability"], wanted.probability, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["margin"], wanted.margins, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found["known"], margins_of(heights, SETUP).known)
    some = [known.mean() for known in np.asarray(found["known"])]
    assert some[0] == 1 and 0 < some[1] < 1 and some[2] == 0


def test_a_map_alone_has_the_results_it_has_among_others(function, heights):
    among = function(heights)
    for name, array in function(heights[1:2]).items():
        np.testing.assert_allclose(array[0], among[name][1], rtol=0, atol=1e-6)


def test_what_is_no_height_is_unknown(function, heights):
    marked = np.where(np.isnan(heights), np.float32(-9999), heights)
    marked[2, 14, 14:18] = np.inf, -np.inf, 1e6, -32768
    found, wanted = function(marked), function(heights)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("model", ["nearest", "tyre"])
def test_the_simulator_returns_the_same_bits_as_simulate(heights, model, tmp_path):
    setup = Setup(SETUP.robot, SHORT, SETUP.grid, Contact.from_model(model, turn=False))
    simulated = jax.jit(loaded(export_simulator(tmp_path / "it.stablehlo", setup)[0]).call)(heights)
    for one, map_heights in enumerate(heights):
        wanted = margins_of(map_heights, setup)
        assert set(simulated) == {*wanted.names, "known", "failed"}
        for name in wanted.names:
            np.testing.assert_array_equal(simulated[name][one], wanted[name])
        np.testing.assert_array_equal(simulated["known"][one], wanted.known)
        np.testing.assert_array_equal(simulated["failed"][one], failures(wanted, setup.robot))


def test_the_file_is_for_any_number_of_maps_on_cpu_and_gpu(field_file):
    exported = loaded(field_file)
    assert exported.platforms == PLATFORMS == ("cpu", "cuda")
    assert str(exported.in_avals[0].shape) == "(b, 33, 33)"


def test_the_description_says_what_the_file_is(field_file, tmp_path):
    said = described(field_file)
    assert {part: said[part] for part in SETUP.to_json()} == SETUP.to_json()
    assert said["events"] == ["step", "obstacle", "tilt"] and said["limits"] == list(SETUP.robot.limits)
    assert set(said["outputs"]) == {"probability", "margin", "known"} and said["travjax"]
    assert said["function"] == "field"
    simulator = described(export_simulator(tmp_path / "it.stablehlo", SETUP)[0])
    assert simulator["function"] == "simulator, contact model nearest"


def test_a_file_of_travjax_is_replaced_and_no_other(tmp_path):
    to = tmp_path / "it.stablehlo"
    for _ in range(2):
        export_simulator(to, SETUP)
    to.write_bytes(b"of the user")
    with pytest.raises(InputError, match="is in the way, and no exported file of travjax"):
        export_simulator(to, SETUP)
    assert to.read_bytes() == b"of the user"
    Path(f"{tmp_path}/other.stablehlo.json").write_text("{}")
    with pytest.raises(InputError, match="is in the way, and no description of travjax"):
        export_simulator(tmp_path / "other.stablehlo", SETUP)


def test_a_disk_that_is_full_leaves_no_file_without_its_description(monkeypatch, tmp_path):
    def full(path, text):
        raise InputError(f"{path}: No space left on device")

    to = tmp_path / "it.stablehlo"
    with monkeypatch.context() as patch, pytest.raises(InputError, match="it.stablehlo.json: No space left"):
        patch.setattr(exported_file, "save_text", full)
        export_simulator(to, SETUP)
    assert not any(tmp_path.iterdir())
    export_simulator(to, SETUP)
    assert described(to)["sha256"] == sha256(to)


def test_an_estimator_of_single_trajectories_is_refused(tmp_path):
    with pytest.raises(InputError, match="^model = 'resnet50': must be field"):
        export_field(tmp_path / "it.stablehlo", Predictor(resnet_run(), None))
    assert not any(tmp_path.iterdir())
