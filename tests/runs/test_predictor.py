"""Probabilities from maps alone: those of the evaluation, of any heights that label takes; the packaged estimator."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import travjax
from tests.commandline import FEW
from tests.field_runs import RUN, estimator
from tests.small_training import GRID, HUSKY, SETUP, copy, dataset, run_of
from tests.small_training import estimator as resnet
from travjax.config import InputError
from travjax.data.sampling import every_sample
from travjax.data.sensor_noise import filled
from travjax.devices import Devices
from travjax.estimators.map_estimator import map_hazards
from travjax.estimators.map_samples import MapSource
from travjax.evaluation import metrics
from travjax.models.variables import merge_model, split_model
from travjax.runs.checkpoint import Checkpoints
from travjax.runs.evaluator import Evaluator
from travjax.runs.model_file import write_model
from travjax.runs.predictor import DEFAULT, WEIGHTS, Predictor, predict
from travjax.runs.run import Run, load_estimator
from travjax.simulation.actions import ActionSpace
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import STYLES, generate_terrain

pytestmark = pytest.mark.usefixtures("shared_code")


@pytest.fixture(scope="module")
def tiny() -> Predictor:
    """A hazard field with random parameters."""
    return Predictor(RUN, estimator())


def refusal(call, *arguments, **options) -> str:
    with pytest.raises(InputError) as raised:
        call(*arguments, **options)
    assert "\n" not in str(raised.value)
    return str(raised.value)


# ---- Loading


def test_a_run_s_folder_gives_its_estimators(field):
    heights = dataset().heights[:2]
    for which in ("best", "latest"):
        predictor, (run, network, _) = Predictor.load(field, which), load_estimator(field, which)
        assert predictor.run == run and predictor.run.preset.model == "field"
        np.testing.assert_array_equal(
            predictor.predict(heights).probability, Predictor(run, network).predict(heights).probability
        )


def test_a_file_gives_what_was_written(tmp_path, tiny):
    write_model(tmp_path / "tiny.safetensors", RUN, tiny.network, {})
    heights = dataset().heights[0]
    wanted = tiny.predict(heights).probability
    np.testing.assert_array_equal(predict(heights, tmp_path / "tiny.safetensors"), wanted)
    np.testing.assert_array_equal(predict(heights, str(tmp_path / "tiny.safetensors")), wanted)


def test_it_is_shown_in_a_few_lines(tiny):
    text = repr(tiny)
    assert len(text) < 200 and len(text.splitlines()) == 2
    assert text.startswith(f"Predictor({RUN.preset.model} for {RUN.robot.name},") and f"{len(RUN.actions)} traj" in text


def test_what_is_no_estimator_is_refused(tmp_path):
    (tmp_path / "x.npz").touch()
    allowed = "no estimator; allowed: the folder of a training run, or a .safetensors file"
    for name in ("x.npz", "none"):
        assert refusal(Predictor.load, tmp_path / name) == f"{tmp_path / name}: {allowed}"
    assert refusal(Predictor.load, tmp_path).startswith(f"{tmp_path / 'run.json'}: cannot be read")
    assert refusal(predict, np.zeros((129, 129)), tmp_path / "y.safetensors").startswith(
        f"{tmp_path}/y.safetensors: no"
    )


def test_a_folder_without_such_a_checkpoint_is_refused(field):
    assert "holds no checkpoint 'heads'" in refusal(Predictor.load, field, "heads")


# ---- Probabilities and margins


def test_probabilities_are_those_of_the_evaluation(field):
    run, network, _ = load_estimator(field)
    evaluator = Evaluator.from_run(run, dataset(), Devices.all())
    samples = every_sample(dataset().labels, dataset().maps_of("test"))
    found = predict(dataset().heights[dataset().maps_of("test")], field)
    assert found.shape == (6, len(FEW), 3)
    place = np.searchsorted(dataset().maps_of("test"), samples[0])
    np.testing.assert_allclose(found[place, samples[1]], evaluator.probabilities(network, samples), atol=1e-6)


def test_a_resnet_predicts_what_the_evaluation_says():
    predictor, counts, maps = Predictor(run_of(), resnet()), [], dataset().maps_of("test")[:2]
    found = predictor.predict(dataset().heights[maps], counts.append)
    wanted = Evaluator.from_run(run_of(), dataset(), Devices.all()).whole_maps(resnet(), maps)
    np.testing.assert_allclose(found.probability, wanted, atol=1e-5)
    assert found.margins is None and predictor.run.preset.model == "resnet50" and sum(counts) == 2 * len(FEW)
    one = predictor.predict(dataset().heights[maps[1]]).probability
    np.testing.assert_allclose(one, found.probability[1], atol=1e-5)


def test_a_resnet_is_loaded_from_its_run(trained):
    assert Predictor.load(trained).run == Run.load(trained) and Predictor.load(trained).run.preset.model == "resnet50"


def test_probabilities_and_margins_are_the_network_s(tiny):
    heights = dataset().heights[:9]
    found = tiny.predict(heights)
    source = MapSource.from_maps(heights, SETUP, RUN.preset.elevation_scale)
    hazards = np.asarray(map_hazards(*split_model(tiny.network), source, np.arange(9)), np.float64)
    np.testing.assert_allclose(found.probability, 1 / (1 + np.exp(-hazards[..., :3])), atol=1e-6)
    np.testing.assert_allclose(found.margins, hazards[..., 3:] * HUSKY.limits, atol=1e-5)
    assert found.probability.shape == found.margins.shape == (9, len(FEW), 3)
    assert found.probability.std(axis=(0, 1)).min() > 1e-4
    assert not isinstance(found.probability, jax.Array) and not isinstance(found.margins, jax.Array)


def test_a_map_alone_and_one_of_many_are_the_same(tiny):
    heights, counts = dataset().heights[:9], []
    many = tiny.predict(heights, counts.append)
    assert sum(counts) == 9 * len(FEW) and len(counts) == 3
    for index in (0, 3, 8):
        one, batch = tiny.predict(heights[index]), tiny.predict(heights[index : index + 1])
        assert one.probability.shape == one.margins.shape == (len(FEW), 3)
        assert batch.probability.shape == batch.margins.shape == (1, len(FEW), 3)
        for part in ("probability", "margins"):
            np.testing.assert_allclose(getattr(one, part), getattr(many, part)[index], atol=1e-5)
            np.testing.assert_allclose(getattr(batch, part)[0], getattr(many, part)[index], atol=1e-5)


# ---- Damage never says "safe"


def spoilt(network, value: float, part: str):
    """The estimator with one weight set to a value."""
    graph, variables = split_model(network)
    leaves, structure = jax.tree.flatten(variables[part])
    leaves[0] = leaves[0].at[(0,) * leaves[0].ndim].set(value)
    return merge_model(graph, variables | {part: jax.tree.unflatten(structure, leaves)})


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("part", ["trunk", "heads"])
def test_an_estimator_that_puts_out_no_numbers_is_refused(value, part):
    for run, network, maps in ((RUN, estimator(), 2), (run_of(), resnet(), 1)):
        broken = Predictor(run, spoilt(network, value, part), Path("runs/broken"))
        heights = dataset().heights[:maps]
        message = refusal(broken.predict, heights)
        assert message.startswith("runs/broken: the estimator puts out NaN or infinity; allowed: ")
        assert refusal(replace(broken, source=None).predict, heights) == message.removeprefix("runs/broken: ")


def test_a_checkpoint_of_no_numbers_is_refused(field, tmp_path):
    folder = copy(field, tmp_path / "run")
    checkpoints = Checkpoints(folder / "checkpoints")
    state, meta = checkpoints.restore(lambda meta: RUN.template(meta["optimizer"]))
    leaves, structure = jax.tree.flatten(state)
    leaves[0] = np.full_like(leaves[0], np.nan)
    checkpoints.save(99, jax.tree.unflatten(structure, leaves), meta)
    message = refusal(Predictor.load, folder, "latest")
    assert message.startswith(f"{folder}, checkpoint latest: ")
    assert message.endswith(" = nan: must be finite throughout, as the weights of a network are")
    Predictor.load(folder)  # the best one is whole


def test_where_an_estimator_comes_from_is_kept(field, tiny):
    assert Predictor.load(field).source == field
    assert Predictor.load().source == WEIGHTS / f"{DEFAULT}.safetensors"
    assert tiny.source is None


# ---- Heights


def test_a_site_at_2000_m_loses_nothing(tiny):
    heights = dataset().heights[:2].astype(np.float64)
    low, high = (tiny.predict(heights + offset) for offset in (0, 2000))
    np.testing.assert_allclose(high.probability, low.probability, atol=1e-5)
    np.testing.assert_allclose(high.margins, low.margins, atol=1e-4)


def test_heights_may_be_a_jax_array_or_a_list_of_rows(tiny):
    wanted = tiny.predict(dataset().heights[0]).probability
    for heights in (jnp.asarray(dataset().heights[0]), dataset().heights[0].tolist()):
        np.testing.assert_allclose(tiny.predict(heights).probability, wanted, atol=1e-5)


def test_an_unknown_node_counts_as_the_nearest_known_one(tiny):
    heights = dataset().heights[:2].copy()
    heights[0, 18:24, 14:19] = np.nan
    heights[1, 16, 16] = np.nan  # the centre
    found, wanted = tiny.predict(heights).probability, tiny.predict(filled(heights)).probability
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert np.abs(found[0] - tiny.predict(dataset().heights[0]).probability).max() > 1e-4


def test_a_map_without_known_ground_is_flat(tiny):
    unknown, flat = np.full(GRID.shape, np.nan, np.float32), np.zeros(GRID.shape, np.float32)
    np.testing.assert_array_equal(tiny.predict(unknown).probability, tiny.predict(flat).probability)


def test_masked_nodes_are_unknown(tiny):
    heights = dataset().heights[0].copy()
    mask = np.zeros(GRID.shape, bool)
    mask[19, 15:18] = True
    holes = np.where(mask, np.nan, heights).astype(np.float32)
    masked = np.ma.masked_array(np.where(mask, 99, heights), mask)
    np.testing.assert_allclose(tiny.predict(masked).probability, tiny.predict(holes).probability, atol=1e-5)


@pytest.mark.parametrize(
    ("heights", "said"),
    [
        (np.zeros((129, 129)), "heights: shape [129, 129]: must be [33, 33] or [n, 33, 33]"),
        (np.zeros((2, 2, 33, 33)), "heights: shape [2, 2, 33, 33]: must be "),
        (np.zeros((0, 33, 33)), "heights: zero maps: must be at least one"),
        (np.full((33, 33), "high"), "heights: dtype <U4: must be numbers"),
        (np.full((33, 33), np.inf), "heights = inf: must be metres between"),
    ],
)
def test_heights_that_cannot_be_are_refused(tiny, heights, said):
    assert refusal(tiny.predict, heights).startswith(said)


# ---- Another robot or action space


def test_another_robot_is_refused_with_both_named(tiny):
    said = refusal(tiny.require_trained_for, Robot.load("seekur_jr"))
    assert said == "robot = 'Seekur Jr': must be Husky A200, which the estimator was trained for"
    said = refusal(tiny.require_trained_for, replace(HUSKY, max_step=0.2))
    assert said == (
        "robot = 'Husky A200': must be Husky A200 of other dimensions or limits, which the estimator was trained for"
    )


def test_another_action_space_or_grid_is_refused_with_both_named(tiny):
    said = refusal(tiny.require_trained_for, actions=ActionSpace())
    assert said.startswith("actions = ActionSpace(turns=18, ") and f"must be {FEW}, which the estimator" in said
    said = refusal(tiny.require_trained_for, grid=replace(GRID, size=8))
    allowed = "Grid(size=4, spacing=0.125), which the estimator was trained for"
    assert said == f"grid = Grid(size=8, spacing=0.125): must be {allowed}"


def test_its_own_robot_and_actions_are_taken(tiny):
    tiny.require_trained_for()
    tiny.require_trained_for(Robot.load("husky_a200"), FEW, GRID)


# ---- The estimator that comes with the package


@pytest.fixture(scope="module")
def packaged() -> Predictor:
    return Predictor.load()


def test_the_packaged_estimator_is_for_the_seekur_jr_and_the_paper_s_actions(packaged):
    run = packaged.run
    run.setup.require_same(Setup(Robot.load("seekur_jr")), "estimator")
    assert run.setup.as_in_paper and run.preset.model == "field"
    assert (WEIGHTS / f"{DEFAULT}.safetensors").stat().st_size <= 15e6
    assert (WEIGHTS / f"{DEFAULT}.md").read_text().startswith(f"# {DEFAULT}.safetensors\n")


def test_the_packaged_estimator_is_right_on_fresh_maps(packaged):
    """Eight maps of seeds unlike those of its training; the quality of the data set's test maps is 0.94."""
    styles = [STYLES[index % len(STYLES)] for index in range(8)]
    seeds = [4_000_000_000 + index for index in range(8)]
    assert not set(seeds) & set(packaged.run.preset.dataset.seeds().tolist())
    heights = np.asarray(generate_terrain(styles, seeds))
    found, exact = packaged.predict(heights), travjax.simulate(heights)
    failed, limits = np.asarray(travjax.failures(exact)), np.array(packaged.run.robot.limits)
    scores = metrics.evaluate(found.probability.reshape(-1, 3), failed.reshape(-1, 3))
    assert failed.any(axis=(0, 1)).all() and scores.scores["overall"].confusion.f1 > 0.85
    margins = np.asarray(exact.events())
    near = margins < 2 * limits
    error = [np.abs(found.margins - margins)[..., event][near[..., event]].mean() for event in range(3)]
    assert (error < 0.15 * limits).all()
    np.testing.assert_allclose(travjax.predict(heights), found.probability, atol=1e-6)


def test_the_packaged_estimator_has_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named, usual = Predictor.load("field_seekur_jr"), Predictor.load()
    assert named.source == usual.source and named.run.setup == usual.run.setup
    (tmp_path / "field_seekur_jr").mkdir()
    with pytest.raises(InputError, match="field_seekur_jr"):
        Predictor.load("field_seekur_jr")  # a folder of that name comes first
    assert Predictor.load().source == usual.source  # which nobody asked for here
