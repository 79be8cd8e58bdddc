"""Figures of evaluation, training and inputs: what is drawn is what was given, and the files open."""

import numpy as np
import pytest
from matplotlib.colors import same_color

from tests.evaluation.test_map_figures import colours, pixels, within
from travjax.evaluation import score_figures
from travjax.evaluation.metrics import NAMES, PAPER_REAL, PAPER_SYNTHETIC, Evaluation, evaluate
from travjax.simulation.events import EVENTS
from travjax.simulation.grid import Grid

GRID = Grid(8.0, 0.125)


def evaluation(separation=3.0, seed=0, without=None) -> Evaluation:
    """A network of some quality; `without`: an event that never happens."""
    draw = np.random.default_rng(seed)
    failed = draw.random((4000, 3)) < (0.1, 0.2, 0.05)
    if without:
        failed[:, EVENTS.index(without)] = False
    score = draw.standard_normal(failed.shape) + separation * failed - 2
    return evaluate(1 / (1 + np.exp(-2 * score)), failed)


def labelled_lines(ax) -> dict[str, tuple[list, list]]:
    """The data of the lines that a legend names."""
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    return {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in lines}


# ---- Precision and recall


def test_the_network_the_baselines_and_the_paper_are_drawn(tmp_path):
    network, baseline = evaluation(), evaluation(1.0, seed=1)
    figure = score_figures.precision_recall_figure(network, baselines={"slope": baseline})
    image = pixels(figure, tmp_path)
    for ax, name in zip(figure.axes, NAMES, strict=True):
        drawn = labelled_lines(ax)
        for label, one in (("network", network), ("slope", baseline)):
            recall, precision = drawn[f"{label}, AP {one.average_precision[name]:.3f}"]
            np.testing.assert_array_equal(recall, [0, *one.curves[name].recall])
            np.testing.assert_array_equal(precision[1:], one.curves[name].precision)
        ours, paper = network.scores[name].confusion, PAPER_SYNTHETIC[name]
        assert drawn["network at 0.5"] == ([ours.recall], [ours.precision])
        assert drawn["paper"] == ([paper.recall], [paper.precision])
        assert ax.get_title().startswith(f"{name}: {ours.failures:.2%}")
        assert [text.get_text() for text in ax.get_legend().get_texts()] == list(drawn)
        assert colours(within(ax, image)) > 20


def test_the_area_under_the_steps_is_the_average_precision():
    network = evaluation()
    ax = score_figures.precision_recall_figure(network).axes[3]
    line = next(line for line in ax.lines if line.get_label().startswith("network, AP"))
    assert line.get_drawstyle() == "steps-pre"
    area = np.sum(np.diff(line.get_xdata()) * line.get_ydata()[1:])
    assert area == pytest.approx(network.average_precision["overall"], abs=0.005)  # of a thinned curve


def test_lines_of_equal_f1_are_that():
    ax = score_figures.precision_recall_figure(evaluation()).axes[0]
    lines = [line for line in ax.lines if line.get_label().startswith("_")]
    texts = [text.get_text() for text in ax.texts]
    assert len(lines) == len(texts) == 4
    for line, text in zip(lines, texts, strict=True):
        recall, precision = line.get_data()
        np.testing.assert_allclose(2 * recall * precision / (recall + precision), float(text.removeprefix("F1 ")))


def test_where_no_sample_fails_no_curve_is_drawn_and_the_legend_says_so(tmp_path):
    figure = score_figures.precision_recall_figure(evaluation(without="tilt"), paper=PAPER_REAL)
    pixels(figure, tmp_path)
    assert labelled_lines(figure.axes[2]) == {"network: no sample fails": ([], [])}
    assert "paper" in labelled_lines(figure.axes[0])
    assert "paper" not in labelled_lines(score_figures.precision_recall_figure(evaluation(), paper=None).axes[0])


def test_more_baselines_than_colours_are_all_drawn():
    one = evaluation()
    figure = score_figures.precision_recall_figure(one, paper=None, baselines={f"b{k}": one for k in range(7)})
    assert len(labelled_lines(figure.axes[0])) == 7 + 2


def test_legends_lie_inside_the_figure_and_beside_the_curves(tmp_path):
    name = "logistic regression on the largest slope and step"
    figure = score_figures.precision_recall_figure(evaluation(), baselines={name: evaluation(1.0)})
    pixels(figure, tmp_path)
    figure.draw_without_rendering()
    for ax in figure.axes:
        legend, whole = ax.get_legend().get_window_extent(), figure.bbox
        assert whole.x0 <= legend.x0 < legend.x1 <= whole.x1
        assert whole.y0 <= legend.y0 < legend.y1 <= whole.y1
        assert not any(legend.overlaps(other.get_window_extent()) for other in figure.axes)


# ---- Calibration


@pytest.mark.parametrize("without", [None, "tilt"])
def test_the_reliability_diagram_shows_the_bins(tmp_path, without):
    network = evaluation(without=without)
    figure = score_figures.reliability_figure(network)
    image = pixels(figure, tmp_path)
    for upper, lower, name in zip(figure.axes[:4], figure.axes[4:], NAMES, strict=True):
        bins = network.calibration[name]
        diagonal, drawn = upper.lines
        np.testing.assert_array_equal(*diagonal.get_data())
        np.testing.assert_array_equal(drawn.get_xdata(), bins.probability[bins.count > 0])
        np.testing.assert_array_equal(drawn.get_ydata(), bins.observed[bins.count > 0])
        assert [bar.get_height() for bar in lower.patches] == bins.count.tolist()
        np.testing.assert_allclose([bar.get_x() for bar in lower.patches], bins.edges[:-1])
        assert lower.get_ylim()[1] > max(bins.count)
        assert f"{bins.error:.4f}" in upper.get_title()
        assert upper.get_window_extent().y0 > lower.get_window_extent().y1
        assert colours(within(upper, image)) > 10


def test_empty_bins_are_left_out_of_the_diagram(tmp_path):
    network = evaluate(np.full((10, 3), 0.25), np.zeros((10, 3), bool))
    figure = score_figures.reliability_figure(network)
    pixels(figure, tmp_path)
    assert list(figure.axes[0].lines[1].get_xdata()) == [0.25]


# ---- Training


def training_rows() -> list[dict]:
    """Two epochs of two steps each; the second is phase 2, and its evaluation has no tilt."""
    first = evaluation().average_precision
    second = first | {"tilt": None}
    return [
        {"step": 1, "epoch": 0, "phase": 1, "loss": 2.0, "learning_rate": 1e-3},
        {"step": 2, "epoch": 0, "phase": 1, "loss": 1.5, "learning_rate": 1e-3},
        {"step": 2, "epoch": 0, "phase": 1, "validation_loss": 1.6, "average_precision": first, "f1": {"step": 0.2}},
        {"step": 3, "epoch": 1, "phase": 2, "loss": 1.2, "learning_rate": 1e-4},
        {"step": 4, "epoch": 1, "phase": 2, "loss": 1.0, "learning_rate": 1e-4},
        {"step": 4, "epoch": 1, "phase": 2, "validation_loss": 1.3, "average_precision": second, "f1": {"step": 0.4}},
    ]


def test_training_curves_are_those_of_the_rows(tmp_path):
    rows = training_rows()
    figure = score_figures.training_figure(rows)
    pixels(figure, tmp_path)
    loss, precision, rate, f1 = figure.axes
    assert labelled_lines(loss) == {
        "training": ([1, 2, 3, 4], [2.0, 1.5, 1.2, 1.0]),
        "validation": ([2, 4], [1.6, 1.3]),
    }
    expected = rows[2]["average_precision"]
    drawn = labelled_lines(precision)
    assert drawn["step"] == ([2, 4], [expected["step"]] * 2)
    assert drawn["overall"] == ([2, 4], [expected["overall"]] * 2)
    assert drawn["tilt"] == ([2], [expected["tilt"]])
    assert labelled_lines(f1) == {"step": ([2, 4], [0.2, 0.4])}
    assert rate.lines[0].get_ydata().tolist() == [1e-3, 1e-3, 1e-4, 1e-4]


def test_the_beginning_of_a_phase_is_marked_once():
    for ax in score_figures.training_figure(training_rows()).axes:
        assert [text.get_text() for text in ax.texts] == ["phase 2"]
        assert sum(list(line.get_xdata()) == [2, 2] for line in ax.lines) == 1


MISTYPED = ["a", True, None, [1], {"overall": "a"}, {"overall": [1]}, {"overall": {}}, 10**19]


@pytest.mark.parametrize("value", MISTYPED)
def test_what_is_no_number_is_not_drawn(tmp_path, value):
    keys = ("phase", "loss", "validation_loss", "learning_rate", "average_precision", "f1")
    rows = [{"step": 1, "loss": 0.5, "phase": 1}, *({"step": 2, key: value} for key in keys), {"step": 3, "loss": 0.25}]
    figure = score_figures.training_figure(rows)
    pixels(figure, tmp_path)
    steps, losses = labelled_lines(figure.axes[0])["training"]
    assert [steps[0], losses[0], steps[-1], losses[-1]] == [1, 0.5, 3, 0.25]
    assert len(steps) == (3 if value == 10**19 else 2)


@pytest.mark.parametrize("rows", [[], [{"step": 5}], [{"step": 1, "loss": 0.5}], [{"step": 1, "f1": {}}]])
def test_rows_may_lack_anything(tmp_path, rows):
    figure = score_figures.training_figure(rows)
    pixels(figure, tmp_path)
    assert all(not ax.texts for ax in figure.axes)


# ---- Inputs


def images(count: int) -> np.ndarray:
    """Channels that tell directions apart: ground rises to the north, the path is in the east, wheels in the west."""
    y, x = np.meshgrid(GRID.axis(), GRID.axis(), indexing="ij")
    return np.stack([np.stack([y * (k + 1) / 4, x > 3, x < -3], axis=-1) for k in range(count)]).astype(np.float32)


@pytest.mark.parametrize("count", [1, 3])
def test_inputs_are_drawn_channel_by_channel_and_together(tmp_path, count):
    given = images(count)
    figure = score_figures.input_channels_figure(given, [f"sample {k}" for k in range(count)], GRID)
    pixels(figure, tmp_path)
    panels = np.array([ax for ax in figure.axes if ax.get_label() != "<colorbar>"]).reshape(count, 4)
    for row, image in zip(panels, given, strict=True):
        for channel in range(3):
            np.testing.assert_array_equal(row[channel].images[0].get_array(), image[..., channel])
        composite = np.asarray(row[3].images[0].get_array())
        np.testing.assert_array_equal(composite[..., 1:], image[..., 1:])
        assert (composite[0, :, 0] == 0).all()
        assert (composite[-1, :, 0] == 1).all()
    assert [ax.get_title().split(",")[0] for ax in panels[0]] == ["elevation", "trajectory", "wheels", "as red"]
    assert [row[0].get_ylabel().splitlines()[0] for row in panels] == [f"sample {k}" for k in range(count)]


def test_north_is_up_and_east_is_right(tmp_path):
    figure = score_figures.input_channels_figure(images(1), ["one"], GRID)
    image = pixels(figure, tmp_path)
    elevation, trajectory, wheels, _ = (within(ax, image).mean(axis=-1) for ax in figure.axes[:4])
    assert elevation[:20].mean() > 200 > 50 > elevation[-20:].mean()
    assert trajectory[:, -10:].mean() > 200 > 50 > trajectory[:, :10].mean()
    assert wheels[:, :10].mean() > 200 > 50 > wheels[:, -10:].mean()


def test_a_flat_map_draws(tmp_path):
    pixels(score_figures.input_channels_figure(np.zeros((1, *GRID.shape, 3), np.float32), ["flat"], GRID), tmp_path)


def test_every_name_has_a_colour_of_its_own():
    used = [*score_figures.COLOURS, "black", *score_figures.BASELINES]
    assert not any(same_color(one, other) for k, one in enumerate(used) for other in used[:k])
