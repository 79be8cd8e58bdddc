"""Features of a frozen trunk in a file: read where they are of the same data set, trunk and samples only."""

from dataclasses import replace

import numpy as np
import pytest

from tests.small_training import dataset, run_of
from travjax.devices import Devices
from travjax.models.variables import split_model
from travjax.training.fit import FEATURES, fit
from travjax.training.trainer import Trainer
from travjax.training.trunk_features import kept, origin_of

SAMPLES = {"training": (np.arange(3), np.arange(3)), "validation": (np.arange(2), np.arange(2))}


def variables(seed: int = 0):
    return split_model(run_of().create(seed))[1]


def test_another_run_data_set_trunk_and_other_samples_are_another_origin():
    run = run_of()
    preset, robot = run.preset, replace(run.setup.robot, ride_height=run.setup.robot.ride_height / 2)
    runs = [
        replace(run, setup=replace(run.setup, robot=robot)),
        replace(run, preset=replace(preset, elevation_scale=0.3)),
        replace(run, preset=replace(preset, trunk=replace(preset.trunk, dtype="bfloat16"))),
        replace(run, preset=replace(preset, trunk=replace(preset.trunk, epsilon=0.1))),
    ]
    others = {"training": SAMPLES["training"], "validation": SAMPLES["training"]}
    renamed = {"training": SAMPLES["training"], "test": SAMPLES["validation"]}
    first = variables()
    moved = first | {"statistics": variables(1)["trunk"]}
    origins = [
        origin_of(run, "this", first, SAMPLES),
        origin_of(run, "another", first, SAMPLES),
        origin_of(run, "this", first, others),
        origin_of(run, "this", first, renamed),
        origin_of(run, "this", variables(1), SAMPLES),
        origin_of(run, "this", moved, SAMPLES),
        *(origin_of(other, "this", first, SAMPLES) for other in runs),
    ]
    assert len(set(origins)) == len(origins)
    later = replace(run, preset=replace(preset, training=replace(preset.training, epochs=7)))
    assert origin_of(later, "this", first | {"heads": variables(1)["heads"]}, SAMPLES) == origins[0]


@pytest.mark.parametrize("damage", ["none", "missing", "no archive", "half of it", "another origin"])
def test_only_a_whole_file_of_the_same_origin_is_read(tmp_path, damage):
    path, computed = tmp_path / "features.npz", []
    features = {"training": np.arange(6.0).reshape(2, 3), "origin": np.ones((1, 3)), "file": np.ones((0, 3))}

    def compute():
        computed.append(True)
        return features

    kept(path, "this", compute)
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage in ("no archive", "half of it"):
        path.write_bytes(b"\x93NUMPY" if damage == "no archive" else data[: len(data) // 2])
    origin = "that" if damage == "another origin" else "this"
    for _ in range(2):
        found = kept(path, origin, compute)
        assert list(found) == list(features)
        assert all(np.array_equal(found[name], array) for name, array in features.items())
    assert len(computed) == (1 if damage == "none" else 2)


def test_features_that_cannot_be_written_are_still_there(tmp_path, capsys):
    (tmp_path / "features.npz").mkdir()
    features = {"training": np.ones((1, 3))}
    assert kept(tmp_path / "features.npz", "this", lambda: features) is features
    said = capsys.readouterr().out
    assert said.startswith(f"{tmp_path / 'features.npz'}: ") and said.endswith("are kept in memory alone\n")


def test_a_run_that_goes_on_in_phase_1_reads_its_features_and_phase_2_removes_them(tmp_path, monkeypatch):
    run, place, passes = run_of(head_epochs=2, epochs=1), tmp_path / "run", []
    over, finish_epoch = Trainer._over, Trainer._finish_epoch

    def noted(trainer, function, samples, what):
        passes.append(what)
        return over(trainer, function, samples, what)

    def interrupted(trainer, rate):
        finish_epoch(trainer, rate)
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "_over", noted)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "_finish_epoch", interrupted)
        fit(run, place, Devices.all(), dataset())
    assert passes == ["training features", "validation features"]
    assert (place / FEATURES).exists()
    assert fit(run, place, Devices.all(), dataset(), resume=True)
    assert passes == ["training features", "validation features", "validation"]  # the last one in phase 2
    assert not (place / FEATURES).exists()
