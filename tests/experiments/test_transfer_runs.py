"""The transfer experiment's runs: what they share, where they begin, what is computed once, and going on."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests import field_runs
from tests.field_runs import begun
from tests.small_training import HUSKY, PRESET, dataset, differing, require_equal, rows_of, saved_state
from travjax.config import InputError
from travjax.data.sampling import every_sample, natural_sample
from travjax.devices import Devices
from travjax.estimators import trajectory_estimator
from travjax.estimators.preset import TrainingConfig
from travjax.evaluation import metrics
from travjax.experiments import transfer_runs
from travjax.experiments.transfer_runs import (
    ARMS,
    FIELD_ARMS,
    IMAGENET,
    SCRATCH,
    SYNTHETIC,
    Transfer,
    TransferConfig,
    run_all,
)
from travjax.runs.evaluator import Evaluator
from travjax.runs.run import Run
from travjax.simulation.events import UNKNOWN_LABEL
from travjax.simulation.robot import Robot

pytestmark = pytest.mark.usefixtures("shared_code")

SITES = np.array(["hill", "plain", "dune"])
FROZEN = TransferConfig(
    seeds=(0, 1),
    trajectories_per_map=5,
    shown="hill",
    training=TrainingConfig(
        batch_size=8, head_epochs=2, epochs=0, learning_rate=1e-3, trajectories_per_map=3, failing_per_map=2
    ),
)
WHOLE = replace(FROZEN, seeds=(3,), training=replace(FROZEN.training, head_epochs=0, epochs=1))


@pytest.fixture(scope="module")
def real():
    """The data set of `trained` as if it were of three real sites."""
    sites = np.resize(SITES, len(dataset().split))
    return replace(dataset(), config=None, group=sites)


@pytest.fixture(scope="module")
def frozen(trained, real, tmp_path_factory):
    """An experiment with frozen trunks, its rows, and how often features of samples were computed."""
    computed: list[str] = []
    over_samples, folder = trajectory_estimator.over_samples, tmp_path_factory.mktemp("frozen")

    def counted(function, *arguments):
        computed.extend(["features"] * (function is trajectory_estimator.sample_features))
        return over_samples(function, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectory_estimator, "over_samples", counted)
        made = Transfer(FROZEN, Run.load(trained), trained, real, folder, Devices.all())
        rows = run_all(made, lambda arm, seed: None)
    return made, rows, computed


def test_every_run_has_a_row_for_its_first_state_and_each_epoch(frozen):
    made, rows, _ = frozen
    assert list(rows) == list(ARMS)
    for seeds in rows.values():
        assert list(seeds) == [0, 1]
        for run in seeds.values():
            assert [row["epoch"] for row in run] == [0, 1, 2]
            assert all(set(row["eval_sets"]) == set(made.held_out) for row in run)


def test_the_held_out_samples_are_natural_ones_of_the_test_maps_of_each_site(real, frozen):
    held_out = frozen[0].held_out
    test = real.maps_of("test")
    assert set(held_out) == set(real.group[test])
    for site, samples in held_out.items():
        of_site = test[real.group[test] == site]
        wanted = natural_sample(real.labels, of_site, 0, len(of_site), 5)
        np.testing.assert_array_equal(samples, wanted)
        assert len(samples[0]) == 5 * len(of_site)


def test_zero_stands_for_all_trajectories_of_the_held_out_windows(trained, real, tmp_path):
    made = Transfer(replace(FROZEN, trajectories_per_map=0), Run.load(trained), trained, real, tmp_path, Devices.all())
    test = real.maps_of("test")
    for site, samples in made.held_out.items():
        wanted = every_sample(real.labels, test[real.group[test] == site])
        assert sorted(zip(*samples, strict=True)) == sorted(zip(*wanted, strict=True))


def test_all_arms_and_seeds_train_on_the_same_samples_with_the_same_settings(frozen):
    runs = [frozen[0].run_of(arm, seed) for arm in ARMS for seed in FROZEN.seeds]
    free = {"preset": PRESET}
    assert len({replace(run, **free) for run in runs}) == 1
    trainings = {replace(run.preset.training, seed=0) for run in runs}
    assert trainings == {replace(FROZEN.training, subset_seed=0)}
    for run in runs:
        assert replace(run.preset, weights="random", training=FROZEN.training) == replace(
            PRESET, weights="random", training=FROZEN.training
        )


def test_features_of_a_frozen_trunk_are_computed_once_for_all_seeds(frozen):
    made, _, computed = frozen
    each = 2 + len(made.held_out)  # training, validation and every held-out site
    assert computed == ["features"] * (each * len(ARMS))
    assert len(list((made.folder / "features").iterdir())) == len(ARMS)


def test_frozen_trunks_stay_as_they_are_and_heads_begin_by_seed(frozen, trained):
    made = frozen[0]
    trunk = lambda state: {name: array for name, array in state.items() if not name.startswith(("heads", "optimizer"))}
    for arm in ARMS:
        one, other = (saved_state(made.place_of(arm, seed), "heads") for seed in FROZEN.seeds)
        require_equal(trunk(one), trunk(other))
        assert differing(one, other)
    require_equal(trunk(saved_state(made.place_of(SYNTHETIC, 0), "heads")), trunk(saved_state(trained, "best")))
    scratch, pretrained = (saved_state(made.place_of(arm, 0), "heads") for arm in (SCRATCH, SYNTHETIC))
    assert any(name.startswith("trunk") for name in differing(scratch, pretrained))


def test_the_first_state_of_the_synthetic_arm_is_the_untouched_synthetic_model(frozen):
    made, rows, _ = frozen
    evaluator = Evaluator.from_run(made.base, made.dataset, made.devices)
    for site, samples in made.held_out.items():
        counts = metrics.confusions(evaluator.probabilities(made.pretrained, samples), evaluator.failed(samples))
        for seed in FROZEN.seeds:
            first = rows[SYNTHETIC][seed][0]["eval_sets"][site]
            assert {name: scores["confusion"] for name, scores in first.items()} == metrics.json_ready(counts)


def test_a_finished_run_is_read_and_not_trained_again(frozen, trained, real, monkeypatch):
    made, rows, _ = frozen
    monkeypatch.setattr(transfer_runs, "Trainer", None)
    again = Transfer(FROZEN, Run.load(trained), trained, real, made.folder, made.devices)
    assert run_all(again, lambda arm, seed: None) == rows


def test_a_run_that_was_interrupted_goes_on_to_the_same_numbers(frozen, trained, real, tmp_path, monkeypatch):
    made, rows, _ = frozen
    again = Transfer(FROZEN, Run.load(trained), trained, real, tmp_path, made.devices)
    finish = transfer_runs.Trainer._finish_epoch

    def interrupted(trainer, rate):
        finish(trainer, rate)
        if trainer.position.epoch == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(transfer_runs.Trainer, "_finish_epoch", interrupted)
        with pytest.raises(KeyboardInterrupt):
            again.rows(IMAGENET, 1)
    assert len(rows_of(again.place_of(IMAGENET, 1))) < len(rows_of(made.place_of(IMAGENET, 1)))
    again.rows(IMAGENET, 1)
    assert rows_of(again.place_of(IMAGENET, 1)) == rows_of(made.place_of(IMAGENET, 1))
    require_equal(*(saved_state(one.place_of(IMAGENET, 1)) for one in (again, made)))


def test_scores_of_a_finished_run_that_are_damaged_are_one_line(frozen, trained, real, tmp_path):
    made = frozen[0]
    copied = tmp_path / "transfer"
    shutil.copytree(made.folder, copied)
    again = Transfer(FROZEN, Run.load(trained), trained, real, copied, made.devices)
    path = again.place_of(SCRATCH, 0) / "metrics.jsonl"
    scored = [line for line in path.read_text().splitlines() if "eval_sets" in line]
    for lines in (scored[:-1], [scored[0], scored[0], *scored[2:]], [*scored[:-1], scored[-1].replace("hill", "hell")]):
        path.write_text("".join(f"{line}\n" for line in lines))
        with pytest.raises(InputError, match=r"metrics.jsonl: epochs = \[.*: must be 0 to 2, each with scores of "):
            again.rows(SCRATCH, 0)
    path.write_bytes("".join(f"{line}\n" for line in scored).encode() + b"\xff\n")
    assert again.rows(SCRATCH, 0) == made.rows(SCRATCH, 0)


def test_without_frozen_trunks_everything_is_trained_and_random_trunks_differ_by_seed(trained, real, tmp_path):
    made = Transfer(replace(WHOLE, seeds=(3, 4)), Run.load(trained), trained, real, tmp_path, Devices.all())
    rows = made.rows(SYNTHETIC, 3)
    assert [(row["epoch"], row["phase"]) for row in rows] == [(0, 2), (1, 2)]
    moved = differing(saved_state(made.place_of(SYNTHETIC, 3), "best"), saved_state(trained, "best"))
    assert any(name.startswith("trunk/") for name in moved)
    assert not (tmp_path / "features").exists()
    kernels = [made._first(SCRATCH, seed).trunk.conv1.kernel[...] for seed in (3, 4)]
    assert not np.array_equal(*kernels)


def test_the_estimator_of_an_arm_is_that_of_the_epoch_that_is_best_on_validation(frozen):
    made, rows, _ = frozen
    evaluator = Evaluator.from_run(made.base, made.dataset, made.devices)
    (site, samples), *_ = made.held_out.items()
    best = max(rows[SYNTHETIC][1][1:], key=lambda row: row["average_precision"]["overall"])
    counts = metrics.confusions(
        evaluator.probabilities(made.estimator(SYNTHETIC, 1), samples), evaluator.failed(samples)
    )
    assert best["eval_sets"][site]["overall"]["confusion"] == metrics.json_ready(counts["overall"])


# ---- Bad input


def refusal(*arguments) -> str:
    with pytest.raises(InputError) as raised:
        Transfer(*arguments)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_data_set_for_another_robot_is_refused_with_both_named(trained, real, tmp_path):
    other = replace(real, setup=replace(real.setup, robot=Robot.load("leo_rover")))
    message = refusal(FROZEN, Run.load(trained), trained, other, tmp_path, Devices.all())
    assert "Leo Rover" in message and HUSKY.name in message


def test_a_data_set_without_held_out_windows_is_refused(trained, real, tmp_path):
    message = refusal(FROZEN, Run.load(trained), trained, replace(real, split=real.split * 0), tmp_path, Devices.all())
    assert message.startswith("held-out windows = 0")


def test_held_out_sites_have_known_trajectories_and_names_of_their_own(trained, real, tmp_path):
    unknown = replace(real, labels=np.full_like(real.labels, UNKNOWN_LABEL))
    renamed = replace(real, group=np.full_like(real.group, "validation", dtype="<U10"))
    said = [refusal(FROZEN, Run.load(trained), trained, data, tmp_path, Devices.all()) for data in (unknown, renamed)]
    assert said[0].startswith("held-out site ") and said[0].endswith(": known trajectories = 0: must be at least one")
    assert said[1] == "held-out site = 'validation': must be of another name"


def test_a_site_to_show_that_is_not_held_out_is_refused_with_those_that_are(trained, real, tmp_path):
    message = refusal(replace(FROZEN, shown="moon"), Run.load(trained), trained, real, tmp_path, Devices.all())
    assert message.startswith("shown = 'moon'") and "hill" in message


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"seeds": ()}, "seeds"),
        ({"seeds": (1, 1)}, "seeds"),
        ({"seeds": (-1,)}, "seeds"),
        ({"trajectories_per_map": -1}, "trajectories_per_map"),
        ({"shown_maps": math.nan}, "shown_maps"),
        ({"sites": 3}, "sites"),
        ({"training": TrainingConfig(head_epochs=1, epochs=1)}, "[training] head_epochs"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(settings, field):
    with pytest.raises(InputError) as raised:
        TransferConfig(**{"training": FROZEN.training} | settings)
    assert str(raised.value).startswith(f"{field} = ")


def test_figures_of_another_data_set_or_model_are_not_taken_for_ones_of_this(frozen, real, trained):
    made, _, _ = frozen
    others = replace(real, heights=real.heights + np.float32(0.5))
    with pytest.raises(InputError, match=f"data set = '{others.fingerprint}': must be {real.fingerprint}"):
        Transfer(FROZEN, Run.load(trained), trained, others, made.folder, Devices.all()).rows(ARMS[0], 0)
    elsewhere = trained.parent / "elsewhere"
    moved = Transfer(FROZEN, Run.load(trained), elsewhere, real, made.folder, Devices.all())
    with pytest.raises(InputError, match=f"weights = '{elsewhere}': must be {trained}, as in the run so far"):
        moved.rows(SYNTHETIC, 0)
    assert len(moved.rows(SCRATCH, 0)) == 3


def test_the_hazard_field_begins_with_random_weights_and_with_the_synthetic_model(real, tmp_path):
    begun(tmp_path / "synthetic").train()
    training = replace(field_runs.PRESET.training, epochs=1)
    config = replace(FROZEN, seeds=(0,), trajectories_per_map=0, training=training)
    base = Run.load(tmp_path / "synthetic")
    made = Transfer(config, base, tmp_path / "synthetic", real, tmp_path / "out", Devices.all())
    rows = run_all(made, lambda arm, seed: None)
    assert list(rows) == list(FIELD_ARMS)
    assert all([row["epoch"] for row in rows[arm][0]] == [0, 1] for arm in FIELD_ARMS)
    evaluator = Evaluator.from_run(base, real, Devices.all())
    for site, samples in made.held_out.items():
        found = metrics.evaluate(evaluator.probabilities(made.pretrained, samples), evaluator.failed(samples))
        counts = rows["synthetic"][0][0]["eval_sets"][site]["overall"]["confusion"]
        assert counts["tp"] == found.scores["overall"].confusion.tp
    first = [saved_state(made.place_of(arm, 0)) for arm in FIELD_ARMS]
    assert differing(*first)
