"""Presets: what a TOML file gives, the one line for each wrong key or value, schedules and RMSprop."""

import math
import urllib.error
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests.small_training import PRESET, TOML
from travjax.config import InputError, from_json, load_toml, one_line, to_json
from travjax.data.dataset import DatasetConfig
from travjax.data.sensor_noise import CorruptionConfig
from travjax.estimators.names import ESTIMATORS
from travjax.estimators.preset import IMAGENET_WEIGHTS, EvaluationConfig, Preset, TrainingConfig, find_weights
from travjax.experiments.transfer_runs import TransferConfig
from travjax.files import PRESETS, find_preset
from travjax.models.hazard_field import FieldConfig
from travjax.models.trajectory_resnet import HeadsConfig
from travjax.resnet.fetched_weights import KEPT
from travjax.resnet.network import ResNetConfig
from travjax.simulation.actions import ActionSpace

RESNETS, FIELDS = (sorted((PRESETS / model).glob("*.toml")) for model in ESTIMATORS)

FIELD_TOML = """
model = "field"
weights = "none"
[field]
stem = 4
widths = [4, 8, 16]
channels = 3
hidden = 8
margin_weight = 2
momentum = 0.9
dtype = "bfloat16"
[corruption]
probability = 0.5
noise = 0.1
missing = 0.3
coarse = 0.4
[training]
optimizer = "adamw"
head_epochs = 0
max_grad_norm = 0.5
weight_decay = 1e-4
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "preset.toml"
    path.write_text(text)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as raised:
        Preset.load(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


# ---- Files


def test_a_file_gives_every_table_by_name(tmp_path):
    assert Preset.load(written(tmp_path, TOML)) == PRESET


def test_a_file_of_the_hazard_field_gives_its_tables(tmp_path):
    preset = Preset.load(written(tmp_path, FIELD_TOML))
    assert preset.model == "field"
    assert preset.field == FieldConfig(4, (4, 8, 16), 3, 8, 2, momentum=0.9, dtype="bfloat16")
    assert preset.corruption == CorruptionConfig(0.5, 0.1, 0.3, 0.4)
    training = preset.training
    assert (training.optimizer, training.max_grad_norm, training.head_epochs) == ("adamw", 0.5, 0)
    assert from_json(to_json(preset), Preset) == preset


def test_what_is_left_out_is_the_paper(tmp_path):
    preset = Preset.load(written(tmp_path, ""))
    assert preset == Preset()
    assert (preset.model, preset.training.optimizer, preset.training.max_grad_norm) == ("resnet50", "rmsprop", 0)
    assert preset.corruption.probability == 0
    assert preset.dataset == DatasetConfig(56_840, 0, 0.08, 0.02)
    assert preset.trunk == ResNetConfig((3, 4, 6, 3), 64, "1x1", momentum=0.99)
    assert preset.heads == HeadsConfig(512, 0.2)
    training = preset.training
    assert (training.batch_size, training.head_epochs, training.epochs) == (64, 1, 10)
    assert (training.learning_rate, training.decay, training.epsilon) == (1e-4, 0.9, 1e-7)
    assert (training.weight_decay, training.trajectories_per_map, training.failing_per_map) == (0.001, 11, 6)
    assert (training.schedule, training.resample_each_epoch) == ("constant", False)
    assert preset.evaluation == EvaluationConfig(0, 0)


def test_a_preset_comes_back_from_json():
    assert from_json(to_json(PRESET), Preset) == PRESET


@pytest.mark.parametrize("path", RESNETS, ids=lambda path: path.stem)
def test_the_presets_of_the_resnet_are_right(path):
    preset = Preset.load(path)
    steps = (
        preset.dataset.maps * preset.training.trajectories_per_map * preset.training.epochs / preset.training.batch_size
    )
    assert preset.trunk.momentum == 0.9 or steps > 1000  # SPEC section 9
    assert preset.trunk.features == 2048


@pytest.mark.parametrize("path", FIELDS, ids=lambda path: path.stem)
def test_the_presets_of_the_hazard_field_are_right(path):
    preset, arcs = Preset.load(path), ActionSpace().turns * len(ActionSpace().radii)
    assert (preset.model, preset.robot, preset.weights) == ("field", "seekur_jr", "none")
    assert preset.training.optimizer == "adamw" and preset.training.schedule == "cosine"
    assert preset.corruption.probability > 0.3
    assert len(ActionSpace().radii) <= preset.training.trajectories_per_map < len(ActionSpace()) == 13 * arcs
    steps = preset.dataset.split_sizes()[0] / preset.training.batch_size * preset.training.epochs
    assert steps > 3 * preset.training.warmup_steps


def test_both_models_have_the_same_presets_but_one():
    assert [path.stem for path in FIELDS] == ["laptop", "paper", "smoke"]
    assert [path.stem for path in RESNETS] == ["laptop", "paper", "smoke", "workstation"]


def test_a_workstation_trains_on_five_times_the_maps_of_a_laptop():
    laptop, workstation = (Preset.load(find_preset(name, "resnet50")) for name in ("laptop", "workstation"))
    assert workstation.dataset.maps == 5 * laptop.dataset.maps
    assert workstation.training.epochs == 2
    same = {"validation_samples": 1, "epochs": 1}
    assert replace(workstation.training, **same) == replace(laptop.training, **same)
    assert workstation.trunk == ResNetConfig(momentum=0.99)  # it takes thousands of steps


def test_there_is_a_preset_of_the_paper():
    paper = Preset.load(next(path for path in RESNETS if path.stem == "paper"))
    assert replace(paper.training, checkpoint_steps=1) == TrainingConfig(checkpoint_steps=1)
    assert replace(paper.trunk, dtype="float32") == ResNetConfig()
    assert (paper.dataset, paper.heads, paper.evaluation) == (DatasetConfig(), HeadsConfig(), EvaluationConfig())


# ---- What is wrong with a file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("maps = 3", "unknown key 'maps'; allowed: model, robot, weights, elevation_scale, dataset, trunk, heads"),
        ("[dataset]\nmap = 3", "[dataset] unknown key 'map'; allowed: maps, seed, validation, test"),
        ("[training]\nlearning_rates = 3", "[training] unknown key 'learning_rates'; allowed: seed, batch_size, "),
        ("[evaluations]\nmaps = 3", "unknown key 'evaluations'; allowed: "),
        ("[trunk]\nwidth_deg = 3", "[trunk] unknown key 'width_deg'; allowed: blocks, width"),
        ("training = 3", "training = 3: must be a table [training]"),
        ("[[training]]\nseed = 3", "training = [{'seed': 3}]: must be a table [training]"),
        ("robot = 3", "robot = 3: must be a non-empty text"),
        ('weights = ""', "weights = '': must be a non-empty text"),
        ("elevation_scale = 0", "elevation_scale = 0: must be a length in metres from 0.001 to 1000"),
        (
            "[training]\ntrajectories_per_map = 0xfffffffff",
            "[training] trajectories_per_map = 68719476735: must be at most 2147483647",
        ),
        ("[dataset]\nmaps = 0", "[dataset] maps = 0: must be a whole number from 1 to 10000000"),
        ("[trunk]\nblocks = 3", "[trunk] blocks = 3: must be 1 to 8 whole numbers from 1 to 26"),
        ("[heads]\nhidden = 0", "[heads] hidden = 0: must be a number from 1 to 65536"),
        (
            "[evaluation]\ntrajectories_per_map = -1",
            "[evaluation] trajectories_per_map = -1: must be a whole number, at least 0",
        ),
        ("[training]\nbatch_size = 0", "[training] batch_size = 0: must be a whole number, at least 1"),
        ("[training]\nbatch_size = 8.0", "[training] batch_size = 8.0: must be a whole number, at least 1"),
        ("[training]\nseed = -1", "[training] seed = -1: must be a whole number, at least 0"),
        ("[training]\nseed = 2147483648", "[training] seed = 2147483648: must be at most 2147483647"),
        ("[training]\nseed = true", "[training] seed = True: must be a whole number, at least 0"),
        (
            "[training]\ntrajectories_per_map = 2",
            "[training] failing_per_map = 6: must be at most trajectories_per_map = 2",
        ),
        ("[training]\nlearning_rate = nan", "[training] learning_rate = nan: must be above 0 and at most 10"),
        ("[training]\ndecay = 0", "[training] decay = 0: must be above 0 and at most 1"),
        ("[training]\nepsilon = -1", "[training] epsilon = -1: must be above 0 and at most 1"),
        ("[training]\nweight_decay = -0.1", "[training] weight_decay = -0.1: must be from 0 to 10"),
        ('[training]\nschedule = "step"', "[training] schedule = 'step': must be one of constant, cosine"),
        ("[training]\nresample_each_epoch = 1", "[training] resample_each_epoch = 1: must be true or false"),
        ('[training]\noptimizer = "adam"', "[training] optimizer = 'adam': must be one of rmsprop, adamw"),
        ("[training]\nmax_grad_norm = -1", "[training] max_grad_norm = -1: must be from 0 to 1000000"),
        ('model = "unet"', "model = 'unet': must be one of resnet50, field"),
        ('model = "field"', "[training] head_epochs = 1: must be 0: the hazard field has no frozen trunk"),
        ("[field]\nwidths = []", "[field] widths = (): must be 1 to 6 whole numbers from 1 to 1024"),
        ("[field]\nwidth = 3", "[field] unknown key 'width'; allowed: stem, widths, channels, hidden"),
        ("[corruption]\nprobability = 2", "[corruption] probability = 2: must be a share from 0 to 1"),
        ("[corruption]\nmissing = 1", "[corruption] missing = 1: must be a share from 0 to 0.9"),
        ("[training]\nepochs = 0\nhead_epochs = 0", "[training] epochs = 0: must be at least 1 where head_epochs is 0"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, text, message):
    assert refusal(written(tmp_path, text)).startswith(message)


def test_no_weight_decay_is_allowed():
    assert TrainingConfig(weight_decay=0).weight_decay == 0


def test_a_missing_file_is_named(tmp_path):
    assert refusal(tmp_path / "none.toml") == "cannot be read: No such file or directory"


# ---- Schedules and the optimizer


def rates(phase: int = 2, steps: int = 20, **settings) -> np.ndarray:
    schedule = TrainingConfig(learning_rate=0.5, **settings).schedule_of(phase, steps)
    return np.array([float(schedule(step)) for step in range(steps + 1)])


def test_a_constant_rate_is_constant():
    np.testing.assert_allclose(rates(), 0.5)


def test_a_constant_rate_is_warmed_up_in_a_straight_line():
    np.testing.assert_allclose(rates(warmup_steps=5), 0.5 * np.minimum(np.arange(21) / 5, 1), rtol=1e-6)


@pytest.mark.parametrize("warmup", [0, 4])
def test_a_cosine_falls_from_the_rate_to_zero(warmup):
    step = np.arange(21)
    falling = 0.25 * (1 + np.cos(np.pi * (step - warmup) / (20 - warmup)))
    wanted = np.where(step < warmup, 0.5 * step / max(warmup, 1), falling)
    np.testing.assert_allclose(rates(schedule="cosine", warmup_steps=warmup), wanted, atol=1e-6)


def test_a_warmup_may_be_longer_than_the_run():
    assert np.isfinite(rates(schedule="cosine", warmup_steps=30)).all()


def test_the_heads_alone_are_trained_at_the_same_rate_throughout():
    np.testing.assert_allclose(rates(phase=1, schedule="cosine", warmup_steps=5), 0.5)


def test_the_optimizer_is_rmsprop_with_epsilon_outside_of_the_root():
    random, rate = np.random.default_rng(0), 0.01
    config = TrainingConfig(learning_rate=rate, decay=0.8, epsilon=1e-3)
    optimizer = config.make_optimizer(2, 10)
    value = random.standard_normal(20).astype(np.float32)
    state, nu = optimizer.init(value), np.zeros(20)
    for _ in range(4):
        gradient = (random.standard_normal(20) * 10.0 ** random.uniform(-6, 2, 20)).astype(np.float32)
        moved, state = optimizer.update(gradient, state)
        nu = 0.8 * nu + 0.2 * gradient.astype(float) ** 2
        np.testing.assert_allclose(moved, -rate * gradient / (np.sqrt(nu) + 1e-3), rtol=1e-5)


def test_adamw_is_that_of_numpy_and_leaves_the_loss_alone():
    """Loshchilov and Hutter 2019, algorithm 2, with the usual 0.9, 0.999 and 1e-8."""
    random, rate, decay = np.random.default_rng(0), 0.013, 0.3
    config = TrainingConfig(optimizer="adamw", learning_rate=rate, weight_decay=decay)
    optimizer, value = config.make_optimizer(2, 10), random.standard_normal(20).astype(np.float32)
    state, mean, square = optimizer.init(value), np.zeros(20), np.zeros(20)
    for step in range(1, 5):
        gradient = (random.standard_normal(20) * 10.0 ** random.uniform(-4, 2, 20)).astype(np.float32)
        moved, state = optimizer.update(gradient, state, value)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient.astype(float) ** 2
        adam = mean / (1 - 0.9**step) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
        np.testing.assert_allclose(moved, -rate * (adam + decay * value), rtol=1e-4, atol=1e-6)
    assert config.penalty == 0 and TrainingConfig(weight_decay=decay).penalty == decay


def test_long_gradients_are_cut_and_short_ones_are_not():
    rate = 0.017
    config = TrainingConfig(learning_rate=rate, decay=0.5, epsilon=1.0, max_grad_norm=2.0)
    for length in (0.5, 30.0):
        gradient = {"a": np.array([0.6 * length], np.float32), "b": np.array([0.8 * length], np.float32)}
        optimizer = config.make_optimizer(2, 10)
        moved, _ = optimizer.update(gradient, optimizer.init(gradient))
        for name, share in (("a", 0.6), ("b", 0.8)):
            cut = share * min(length, 2.0)
            np.testing.assert_allclose(moved[name], -rate * cut / (math.sqrt(0.5) * cut + 1), rtol=1e-5)


def test_the_optimizer_follows_the_schedule():
    optimizer = TrainingConfig(learning_rate=0.5, schedule="cosine", warmup_steps=2).make_optimizer(2, 6)
    state, lengths = optimizer.init(np.ones(1, np.float32)), []
    for step in range(6):
        moved, state = optimizer.update(np.ones(1, np.float32), state)
        lengths.append(-float(moved[0]) * math.sqrt(1 - 0.9 ** (step + 1)))
    np.testing.assert_allclose(lengths, rates(steps=6, schedule="cosine", warmup_steps=2)[:6], atol=1e-5)


# ---- Weights


def test_weights_are_found_here_or_under_travjax_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRAVJAX_DATA", str(tmp_path / "data"))
    (tmp_path / "data/imagenet").mkdir(parents=True)
    far = tmp_path / "data/imagenet/w.npz"
    far.touch()
    assert find_weights("imagenet/w.npz") == far
    assert find_weights(str(far)) == far
    (tmp_path / "imagenet").mkdir()
    (tmp_path / "imagenet/w.npz").touch()
    assert find_weights("imagenet/w.npz") == Path("imagenet/w.npz")
    assert find_weights("none") is None


@pytest.mark.parametrize("data", [None, "", "/nowhere"])
def test_missing_weights_are_one_line_that_says_what_to_do(tmp_path, monkeypatch, data):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRAVJAX_DATA", data) if data is not None else monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    with pytest.raises(InputError) as raised:
        find_weights("imagenet/w.npz")
    where = "nor under TRAVJAX_DATA=/nowhere" if data else "and TRAVJAX_DATA is not set"
    allowed = "allowed: --weights FILE, or none for random ones"
    assert str(raised.value) == f"weights imagenet/w.npz: no such file here, {where}; {allowed}"


@pytest.fixture
def empty(tmp_path, monkeypatch) -> Path:
    """A working folder without weights, and no TRAVJAX_DATA; the cache is there as well."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_imagenet_weights_that_are_not_at_hand_come_from_the_cache(empty, monkeypatch):
    kept = empty / "travjax" / KEPT
    kept.parent.mkdir(parents=True)
    kept.touch()
    assert find_weights(IMAGENET_WEIGHTS) == kept
    (empty / "data/imagenet").mkdir(parents=True)
    (empty / "data" / IMAGENET_WEIGHTS).touch()
    monkeypatch.setenv("TRAVJAX_DATA", str(empty / "data"))
    assert find_weights(IMAGENET_WEIGHTS) == empty / "data" / IMAGENET_WEIGHTS


def test_offline_one_line_names_the_ways_to_get_them(empty, monkeypatch):
    def urlopen(address, timeout):
        raise urllib.error.URLError("Network is unreachable")

    monkeypatch.setattr("urllib.request.urlopen", urlopen)
    with pytest.raises(InputError) as raised:
        find_weights(IMAGENET_WEIGHTS)
    said = one_line(raised.value)
    assert said.startswith(f"weights {IMAGENET_WEIGHTS}: neither here nor under TRAVJAX_DATA, and not to be fetched: ")
    for part in (
        "Network is unreachable; allowed: ",
        "--weights FILE (make train WEIGHTS=FILE) fetched elsewhere, as travjax weights --from FILE writes it",
        "or TRAVJAX_DATA with this file; --weights none; ",
    ):
        assert part in said
    assert said.endswith("; --model field (make train MODEL=field) needs none")
    assert find_weights("none") is None


def test_every_setting_is_explained():
    for kind in (TrainingConfig, EvaluationConfig, Preset, FieldConfig, CorruptionConfig):
        for field in fields(kind):
            inner = field.name in ("dataset", "trunk", "heads", "training", "evaluation")
            assert inner or field.name in kind.__doc__, field.name


# ---- Old keys

OLD = {
    "share": "probability",
    "method": "optimizer",
    "clip": "max_grad_norm",
    "each": "trajectories_per_map",
    "failing": "failing_per_map",
    "fresh": "resample_each_epoch",
}
ALL_KEYS = """
[corruption]
probability = 0.5
[training]
optimizer = "adamw"
max_grad_norm = 0.5
trajectories_per_map = 9
failing_per_map = 4
resample_each_epoch = true
[evaluation]
trajectories_per_map = 7
"""


def aged(text: str, *keys: str) -> str:
    """The text with old keys."""
    for key in keys:
        text = text.replace(f"{OLD[key]} =", f"{key} =")
    return text


@pytest.mark.parametrize("key", OLD)
def test_an_old_key_gives_the_same_preset_and_one_notice(tmp_path, capsys, key):
    now = Preset.load(written(tmp_path, ALL_KEYS))
    assert capsys.readouterr().out == ""
    path = written(tmp_path, aged(ALL_KEYS, key))
    assert Preset.load(path) == now
    assert capsys.readouterr().out == (
        f"{path}: key {key!r} is now called {OLD[key]!r}; the old name will not be read by the next version\n"
    )


def test_a_file_of_old_keys_alone_gives_the_same_preset_and_one_notice(tmp_path, capsys):
    now, path = Preset.load(written(tmp_path, ALL_KEYS)), written(tmp_path, aged(ALL_KEYS, *OLD))
    assert Preset.load(path) == now
    said = capsys.readouterr().out
    assert said.startswith(f"{path}: keys 'share', 'method', ") and said.count("\n") == 1
    assert all(repr(name) in said for names in OLD.items() for name in names)


@pytest.mark.parametrize("key", OLD)
def test_a_key_by_its_old_and_its_new_name_is_refused(tmp_path, key):
    new = next(line for line in ALL_KEYS.splitlines() if line.startswith(OLD[key]))
    said = refusal(written(tmp_path, ALL_KEYS.replace(new, f"{new}\n{aged(new, key)}", 1)))
    assert f"] {key} = " in said and said.endswith(f": must be left out beside {OLD[key]}, its name now")


def test_presets_that_come_with_the_package_have_no_old_keys(capsys):
    for path in (*RESNETS, *FIELDS):
        Preset.load(path)
    for path in sorted((PRESETS / "transfer").glob("*.toml")):
        load_toml(path, TransferConfig)
    assert capsys.readouterr().out == ""
