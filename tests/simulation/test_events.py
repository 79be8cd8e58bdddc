"""A robot with a fourth event, roll: from the kernel to a trained estimator, and nothing of it without the limit."""

import functools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commandline import FEW, FEW_TOML, run_words, succeeds
from tests.small_training import GRID, GRID_WORDS, HUSKY, PRESET, TOML, dataset
from travjax.config import InputError, to_json
from travjax.data.dataset import Dataset, generate, load, save
from travjax.data.map_batches import labelled
from travjax.data.sampling import balanced_subset
from travjax.evaluation import map_figures
from travjax.evaluation.dataset_tables import are_headings, statistics_rows, statistics_table
from travjax.evaluation.metrics import evaluate
from travjax.evaluation.tables import metrics_table, shares_table
from travjax.runs.predictor import Predictor
from travjax.runs.run_log import read_rows
from travjax.simulation import events, robot
from travjax.simulation.events import EVENTS, OPTIONAL, PAPER, Event, Pose, label_bit, label_codes
from travjax.simulation.setup import Setup
from travjax.traversal import reference
from travjax.traversal.traverse import failures, packed, simulate, unpacked

ROLLING = replace(HUSKY, max_roll=math.radians(6))
SETUP = Setup(ROLLING, FEW, GRID)
FOUR = (*EVENTS, "roll")

FIELD_TOML = """
[field]
stem = 4
widths = [4, 8]
channels = 3
hidden = 8
[training]
batch_size = 9
head_epochs = 0
epochs = 1
trajectories_per_map = 6
validation_samples = 40
optimizer = "adamw"
"""
RESNET_TOML = "[trunk]" + TOML.partition("[trunk]")[2].replace("batch_size = 8", "batch_size = 32")


@functools.cache
def rolling() -> Dataset:
    """The data set of the small training, for the robot that must not roll."""
    return generate(PRESET.dataset, SETUP)


@functools.cache
def holes() -> np.ndarray:
    """Six of its maps, each with an unknown node ahead of the robot: [6, 33, 33]."""
    heights = rolling().heights[:6].copy()
    for number, one in enumerate(heights):
        one[24, 12 + 2 * number] = np.nan
    return heights


def robot_file(folder: Path) -> Path:
    path = folder / "rolling.toml"
    path.write_text("\n".join(f"{name} = {json.dumps(value)}" for name, value in to_json(ROLLING).items()))
    return path


# ---- The kernel


def contacts_of(heights: np.ndarray, trajectory: int) -> np.ndarray:
    """Heights under the wheels FL, FR, RL, RR at each pose of a trajectory, one after the other: [p, 4] float64."""
    middle = GRID.cells // 2
    found = []
    for x, y, heading in reference.poses(FEW, trajectory).tolist():
        sin, cos = math.sin(heading), math.cos(heading)
        for u, v in ROLLING.wheel_positions():
            col = math.floor((x + u * cos - v * sin) / GRID.spacing + 0.5 + 1e-9) + middle
            row = math.floor((y + u * sin + v * cos) / GRID.spacing + 0.5 + 1e-9) + middle
            found.append(float(heights[row, col]))
    return np.reshape(found, (-1, 4))


def slow_roll(heights: np.ndarray, trajectory: int) -> float:
    left_to_right = contacts_of(heights, trajectory) @ [-1, 1, -1, 1]
    return max(math.atan(abs(slope)) for slope in left_to_right / (2 * ROLLING.track))


def slow_twist(heights: np.ndarray, trajectory: int) -> float:
    return float(np.abs(contacts_of(heights, trajectory) @ [1, -1, -1, 1]).max() / 4)


def assert_is(margin, known, slow, heights: np.ndarray) -> None:
    """A margin is that of the slow loop where it is known, and NaN elsewhere."""
    expected = [[slow(one, trajectory) for trajectory in range(len(FEW))] for one in heights]
    np.testing.assert_allclose(margin, np.where(known, expected, np.nan), rtol=0, atol=2e-6)


@pytest.mark.parametrize("heights", [lambda: rolling().heights[:10], holes], ids=["whole", "holes"])
def test_the_roll_margin_is_that_of_a_slow_loop(heights):
    margins = simulate(heights(), ROLLING, FEW, grid=GRID)
    assert margins.names == FOUR
    assert_is(margins["roll"], margins.known, slow_roll, heights())


def test_the_other_margins_keep_their_bits():
    three, four = (simulate(holes(), one, FEW, grid=GRID) for one in (HUSKY, ROLLING))
    assert 0 < np.asarray(three.known).mean() < 1
    for name in ("step", "obstacle", "tilt", "known"):
        assert np.asarray(getattr(three, name)).tobytes() == np.asarray(getattr(four, name)).tobytes()
    np.testing.assert_array_equal(four.events()[..., :3], three.events())
    np.testing.assert_array_equal(four.events()[..., 3], four["roll"])


def test_a_roll_margin_does_not_depend_on_the_batch():
    whole = simulate(holes(), ROLLING, FEW, grid=GRID)["roll"]
    for index in range(len(holes())):
        alone = simulate(holes()[index], ROLLING, FEW, grid=GRID)["roll"]
        assert np.asarray(alone).tobytes() == np.asarray(whole[index]).tobytes()


def test_on_a_side_slope_the_roll_is_the_slope_and_uphill_it_is_none():
    x, y = np.meshgrid(GRID.axis(), GRID.axis())
    ahead, five_nodes = replace(FEW, turns=1, radii=(math.inf,)), replace(ROLLING, track=5 * GRID.spacing)
    aside, uphill = simulate(np.stack([0.2 * x, 0.2 * y]), five_nodes, ahead, grid=GRID)["roll"][:, 0]
    assert aside == pytest.approx(math.atan(0.2), abs=1e-6)
    assert uphill == pytest.approx(0, abs=1e-6)


def test_an_event_that_a_robot_does_not_have_is_refused():
    margins = simulate(holes(), HUSKY, FEW, grid=GRID)
    with pytest.raises(InputError, match="^event = 'roll': must be one of the robot's: step, obstacle, tilt$"):
        margins["roll"]
    with pytest.raises(InputError, match="^event = 'roll'"):
        failures(margins, ROLLING)


def test_an_event_of_ones_own_is_one_entry(monkeypatch):
    def twist(pose: Pose):
        """Height by which a wheel is off the plane of the other three, over four."""
        front_left, front_right, rear_left, rear_right = pose.contact
        return abs(front_left - front_right - rear_left + rear_right) / 4

    monkeypatch.setattr(robot, "OPTIONAL", (*OPTIONAL, Event("twist", "m", "max_step", twist)))
    margins = simulate(holes(), ROLLING, FEW, grid=GRID)
    assert margins.names == (*FOUR, "twist") and ROLLING.limits[4] == ROLLING.max_step
    assert_is(margins["twist"], margins.known, slow_twist, holes())
    assert_is(margins["roll"], margins.known, slow_roll, holes())
    failed = failures(margins, ROLLING)
    again, known = unpacked(packed(failed, margins.known), ROLLING)
    np.testing.assert_array_equal(again, failed)
    np.testing.assert_array_equal(known, margins.known)


# ---- Labels and data sets


def test_a_label_is_a_byte_of_which_optional_events_have_the_upper_half():
    bits = [label_bit(event) for event in range(7)]
    assert bits == [0, 1, 2, 4, 5, 6, 7] and len(PAPER + OPTIONAL) <= 7
    assert events.FAILED == sum(1 << bit for bit in bits) and events.UNKNOWN_LABEL == 1 << 3
    assert (label_codes(3), label_codes(4), label_codes(7)) == (16, 32, 256)


@pytest.mark.parametrize("count", [3, 4, 7])
def test_what_is_packed_comes_out_again(count, monkeypatch):
    optional = tuple(replace(PAPER[0], name=f"event {number}") for number in range(count - 3))
    monkeypatch.setattr(robot, "OPTIONAL", optional)
    numbers = np.arange(1 << (count + 1))
    bits = (numbers[:, None] >> np.arange(count + 1)) & 1 > 0
    labels = packed(bits[None, :, :count], bits[None, :, count])
    assert labels.dtype == np.uint8 and len(np.unique(labels)) == len(numbers)
    failed, known = unpacked(labels, HUSKY)
    np.testing.assert_array_equal(failed[0], bits[:, :count])
    np.testing.assert_array_equal(known[0], bits[:, count])


def test_labels_have_the_bit_of_roll_beside_those_of_the_paper():
    four, three = rolling().labels, dataset().labels
    np.testing.assert_array_equal(four & 0b1111, three)
    rolls = np.asarray(simulate(rolling().heights, ROLLING, FEW, grid=GRID)["roll"]) > np.float32(ROLLING.max_roll)
    np.testing.assert_array_equal(four >> 4, rolls)
    assert ((four > 0) & (three == 0)).any() and (four == 0).any()


def test_a_data_set_comes_back_with_its_events(tmp_path):
    save(rolling(), tmp_path / "four")
    again = load(tmp_path / "four")
    assert again.robot == ROLLING and again.labels.tobytes() == rolling().labels.tobytes()
    save(dataset(), tmp_path / "three")
    assert "max_roll" not in (tmp_path / "three" / "dataset.json").read_text()


def test_labels_of_more_events_than_the_robot_has_are_refused():
    with pytest.raises(InputError, match="^labels = [0-9]+: must be from 0 to 15$"):
        replace(rolling(), setup=replace(SETUP, robot=HUSKY))


def test_a_balanced_subset_takes_trajectories_that_only_roll():
    labels = np.array([[0, 0, 16, 8, 0]], np.uint8)
    assert set(balanced_subset(labels, [0], 0, each=3, failing=1)[1]) >= {2}
    assert set(balanced_subset(labels, [0], 0, each=5, failing=5)[1]) == {0, 1, 2, 4}


def test_a_labelled_batch_has_the_margin_by_name():
    batch = labelled({"heights": holes()}, SETUP)
    assert list(batch) == ["heights", *FOUR, "known", "failed"] and batch["failed"].shape[-1] == 4


# ---- Tables and figures


def test_tables_have_a_column_of_roll():
    shares = {row["what"]: row for row in statistics_rows(rolling(), as_in_paper=True)}
    failed, known = map(np.asarray, unpacked(rolling().labels, ROLLING))
    assert shares["all maps"]["roll"] == f"{failed[..., 3].sum() / known.sum():.2%}"
    assert shares["all maps"]["any failure"] == f"{failed.any(axis=-1).sum() / known.sum():.2%}"
    assert shares["paper's test set"]["roll"] is None and shares["paper's test set"]["tilt"] == "0.42%"
    for robots in (rolling(), dataset()):
        assert are_headings(statistics_table(robots).splitlines()[0])
    lines = shares_table(rolling().group, failed, known, True, FOUR).splitlines()
    assert lines[0].split()[1:5] == list(FOUR)
    assert shares["all maps"]["roll"] in lines[-2] and "0.42%" in lines[-1]


def test_scores_go_by_the_four_events():
    failed = np.asarray(unpacked(rolling().labels, ROLLING)[0]).reshape(-1, 4)
    scores = evaluate(failed * 0.9, failed, events=FOUR)
    assert list(scores.scores) == [*FOUR, "overall"] and scores.f1["roll"] == 1
    assert scores.scores["overall"].confusion.samples == failed.size
    assert [line.split()[0] for line in metrics_table(scores).splitlines()[2:] if "paper" not in line] == [*scores.f1]
    with pytest.raises(InputError, match="failed = .*: must be \\[s, 3\\], at least one sample"):
        evaluate(failed * 0.9, failed)


def test_figures_have_a_column_of_roll(tmp_path):
    failed, known = map(np.asarray, unpacked(rolling().labels[:2], ROLLING))
    drawn = map_figures.labelled_maps(rolling().heights[:2], failed, known, ["a", "b"], SETUP)
    titles = [ax.get_title() for ax in drawn.axes]
    share = failed[0, :, 3][known[0]].mean()
    assert f"roll: {share:.1%} of known fail" in titles
    assert "largest roll 6.0 deg" in map_figures.robot_figure(ROLLING).axes[1].get_title()
    assert "roll" not in map_figures.robot_figure(HUSKY).axes[1].get_title()


# ---- From the command line, with the robot's file: data set, training, evaluation, prediction


@pytest.fixture(scope="module", params=["field", "resnet"])
def trained(request, tmp_path_factory) -> Path:
    """A run of two steps."""
    folder = tmp_path_factory.mktemp(request.param)
    save(rolling(), folder / "set")
    (folder / "few.toml").write_text(FEW_TOML)
    own = f'model = "field"\n{FIELD_TOML}' if request.param == "field" else RESNET_TOML
    settings = f'robot = "{robot_file(folder)}"\nweights = "none"\nelevation_scale = 0.5\n'
    head, _, tables = own.partition("[")
    (folder / "tiny.toml").write_text(
        f"{settings}{head}{TOML[TOML.index('[dataset]') : TOML.index('[trunk]')]}[{tables}"
    )
    words = ("train", folder / "tiny.toml", "--data", folder / "set", "--actions", folder / "few.toml", *GRID_WORDS)
    succeeds(folder / "run", *words)
    return folder


def test_training_scores_the_four_events(trained):
    validated = [row for row in read_rows(trained / "run" / "metrics.jsonl") if "validation_loss" in row]
    assert list(validated[-1]["average_precision"]) == [*FOUR, "overall", "mean"]
    assert (trained / "run" / "training.png").stat().st_size > 0


def test_evaluation_has_tables_and_figures_of_the_four_events(trained):
    done = succeeds(trained / "evaluated", "evaluate", trained / "run", "--data", trained / "set", "--maps", 0)
    results = json.loads((done.folder / "evaluation.json").read_text())
    assert list(results["network"]["scores"]) == [*FOUR, "overall"]
    assert done.out.count("\nroll ") >= 3  # in the table of scores, and for two recalls in that of thresholds
    if "margin_errors" in results:
        assert list(results["margin_errors"]) == list(FOUR) and "degrees, roll " in done.out


def test_predictions_have_a_probability_of_roll(trained):
    words = ("predict", "--checkpoint", trained / "run", "--count", 2, "--check")
    done = succeeds(trained / "predicted", *words)
    arrays = done.arrays("predictions.npz")
    assert arrays["probability"].shape == (2, len(FEW), 4) and arrays["failed"].shape[-1] == 4
    predictor = Predictor.load(trained / "run")
    found = predictor.predict(rolling().heights[:2])
    assert found.probability.shape == (2, len(FEW), 4)
    if found.margins is not None:
        assert found.margins.shape == (2, len(FEW), 4) and "margin_roll" in arrays
    with pytest.raises(InputError, match="robot = .*: must be Husky A200 of other dimensions or limits"):
        predictor.require_trained_for(HUSKY)


def test_a_robot_with_another_name_for_it_is_refused(tmp_path):
    path = robot_file(tmp_path)
    path.write_text(path.read_text().replace("max_roll", "max_rol"))
    code, _, err = run_words("label", "--robot", path, "--count", 1, "--out", tmp_path / "out")
    assert code == 2 and "unknown key 'max_rol'" in err and "perhaps max_roll is meant" in err
