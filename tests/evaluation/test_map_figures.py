"""Every figure is written, can be opened, and shows what it is about."""

import math

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from travjax.evaluation import map_figures
from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import EVENTS
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

SEEKUR_JR = Robot.load("seekur_jr")
FEW = ActionSpace(turns=4, radii=(math.inf, 1.2, -1.2))
GRID = Grid(8.0, 0.125)
SETUP = Setup(SEEKUR_JR, FEW, GRID)
DPI = 150


def pixels(figure: Figure, folder) -> np.ndarray:
    """The figure as an image file shows it: [rows, cols, 3], row 0 on top. Checks size and content on the way."""
    path = map_figures.save(figure, folder / "figure.png")
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert (image.width, image.height) == pytest.approx(tuple(figure.get_size_inches() * DPI), abs=1)
        assert 400 <= image.width <= 2500
        assert 300 <= image.height <= 4000
        return np.asarray(image.convert("RGB")).astype(int)


def colours(image: np.ndarray) -> int:
    """How many different colours an image has."""
    return len(np.unique(image @ [65536, 256, 1]))


def within(ax, image: np.ndarray) -> np.ndarray:
    """The pixels inside a drawn axes."""
    box = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted()).extents * DPI
    left, bottom, right, top = np.round(box).astype(int)
    return image[len(image) - top + 2 : len(image) - bottom - 2, left + 2 : right - 2]


def count_of(image: np.ndarray, name: str) -> int:
    """Counts pixels that are clearly blue (safe) or red (failed)."""
    red, green, blue = np.moveaxis(image, -1, 0)
    return int(
        {
            "failed": (red > green + 60) & (red > blue + 60),
            "safe": (blue > red + 30) & (blue > green),
        }[name].sum()
    )


def titles(figure: Figure) -> list[str]:
    return [ax.get_title() for ax in figure.axes]


# ---- Saving


def test_a_saved_figure_is_a_png_and_nothing_else_is_left(tmp_path):
    path = map_figures.save(map_figures.robot_figure(SEEKUR_JR), tmp_path / "robot.png")
    assert path == tmp_path / "robot.png"
    assert [file.name for file in tmp_path.iterdir()] == ["robot.png"]


def test_a_figure_that_cannot_be_drawn_leaves_no_file(tmp_path):
    class Half(Figure):
        def savefig(self, path, **options):
            path.write_text("half")
            raise ValueError("no such font")

    with pytest.raises(ValueError, match="no such font"):
        map_figures.save(Half(), tmp_path / "bad.png")
    assert list(tmp_path.iterdir()) == []


NAMES = ["a$\\frac$b", "$x^2$ and $y$", "R $_{$", "line\x07end", "\U0001f600 \u0b95", "\udcff.tif", "50 % \\alpha"]


@pytest.mark.parametrize("name", NAMES)
def test_names_are_drawn_as_they_are(tmp_path, recwarn, name):
    figure = Figure(layout="constrained")
    ax = figure.subplots()
    ax.plot([1, 1000], [1, 2], label=name)
    ax.set(xscale="log", title=f"{name}\nsecond line", xlabel=name)
    ax.annotate(name, (1, 1))
    ax.legend()
    figure.suptitle(name)
    map_figures.save(figure, tmp_path / "names.png")
    shown = name.encode("unicode_escape").decode() if not name.isprintable() else name
    texts = (ax.xaxis.label, figure._suptitle, ax.texts[0], ax.get_legend().get_texts()[0])
    assert [text.get_text() for text in texts] == [shown] * 4
    assert ax.get_title() == f"{shown}\nsecond line"
    assert not any(text.get_parse_math() for text in (*texts, ax.title))
    assert ax.get_xticklabels()[1].get_parse_math()  # powers of ten are set as mathematics
    assert not recwarn.list


# ---- Contact sheets


@pytest.mark.parametrize("count", [1, 2, 6, 9])
def test_a_contact_sheet_shows_every_map_with_its_title(tmp_path, count):
    heights = np.random.default_rng(0).standard_normal((count, *GRID.shape)).astype(np.float32)
    names = [f"seed {number}" for number in range(count)]
    figure = map_figures.contact_sheet(heights, names, "rough", GRID)
    image = pixels(figure, tmp_path)
    shown = [ax for ax in figure.axes if ax.get_visible() and ax.get_title()]
    assert [ax.get_title() for ax in shown] == names
    assert figure.get_suptitle() == "rough"
    for ax in shown:
        assert colours(within(ax, image)) > 100


def corner_brightness(heights: np.ndarray, folder) -> dict[str, float]:
    """Mean brightness of the four sides of a map on a contact sheet."""
    figure = map_figures.contact_sheet(heights[None].astype(np.float32), ["map"], "one", GRID)
    image = pixels(figure, folder)
    one = within(figure.axes[0], image).mean(axis=-1)
    edge = len(one) // 6
    return {
        "north": one[:edge].mean(),
        "south": one[-edge:].mean(),
        "west": one[:, :edge].mean(),
        "east": one[:, -edge:].mean(),
    }


@pytest.mark.parametrize(("side", "opposite"), [("north", "south"), ("east", "west")])
def test_north_is_up_and_east_is_right(tmp_path, side, opposite):
    y, x = np.meshgrid(GRID.axis(), GRID.axis(), indexing="ij")
    bright = corner_brightness({"north": y, "east": x}[side], tmp_path)
    assert bright[side] > bright[opposite] + 50


def test_light_comes_from_the_north_west(tmp_path):
    y, x = np.meshgrid(GRID.axis(), GRID.axis(), indexing="ij")
    bright = corner_brightness(-0.7 * np.hypot(x, y), tmp_path)
    assert min(bright["north"], bright["west"]) > max(bright["south"], bright["east"]) + 5


def test_light_falls_on_the_slopes_where_they_are():
    y, x = np.meshgrid(GRID.axis(), GRID.axis(), indexing="ij")
    west_facing_in_the_north = 0.5 * x * np.sign(y)
    ax = map_figures.contact_sheet(west_facing_in_the_north[None].astype(np.float32), ["map"], "one", GRID).axes[0]
    shade = next(image.get_array() for image in ax.images if image.get_cmap().name == "gray")
    # Row 0 is drawn at the bottom; 35 rows are more than half the map.
    assert shade[35:].mean() > shade[:30].mean() + 0.1


def test_a_flat_map_draws(tmp_path):
    pixels(map_figures.contact_sheet(np.zeros((1, *GRID.shape), np.float32), ["flat"], "flat", GRID), tmp_path)


def test_a_map_with_unknown_ground_draws_it_white(tmp_path):
    heights = np.random.default_rng(0).standard_normal((1, *GRID.shape)).astype(np.float32)
    heights[0, 16:48, 16:48] = np.nan
    figure = map_figures.contact_sheet(heights, ["holes"], "holes", GRID)
    one = within(figure.axes[0], pixels(figure, tmp_path))
    height, width = one.shape[:2]
    middle = one[int(0.35 * height) : int(0.65 * height), int(0.35 * width) : int(0.65 * width)]
    assert (middle == 255).all()


# ---- Labelled maps


def labelled(failed: np.ndarray, known: np.ndarray, heights: np.ndarray | None = None, actions=FEW) -> Figure:
    """The figure of maps that are flat unless given."""
    if heights is None:
        heights = np.zeros((len(failed), *GRID.shape), np.float32)
    names = [f"map {number}" for number in range(len(failed))]
    return map_figures.labelled_maps(heights, failed, known, names, Setup(SEEKUR_JR, actions, GRID))


def paths(ax) -> dict[str, int]:
    """How many trajectories an axes draws in each kind's colour; a kind that has none is left out."""
    kinds = {
        map_figures.SAFE: "safe",
        map_figures.DOUBTFUL: "doubtful",
        map_figures.FAILED: "failed",
        map_figures.UNKNOWN_COLOUR: "unknown",
    }
    drawn = {}
    for lines in ax.collections:
        if isinstance(lines, LineCollection) and lines.get_segments():
            colour = {to_hex(colour) for colour in lines.get_colors()}
            drawn[kinds[colour.pop()]] = len(lines.get_segments())
    return drawn


def event_axes(figure: Figure) -> list:
    """The axes of the three events of each map, in their order."""
    return [ax for ax in figure.axes if ax.get_title().startswith(EVENTS)]


def test_every_trajectory_is_drawn_in_the_colour_of_its_label(tmp_path):
    failed, known = np.zeros((1, 36, 3), bool), np.ones((1, 36), bool)
    known[0, :6] = False
    failed[0, 6:16, 0] = True
    failed[0, 6:, 1] = True
    figure = labelled(failed, known)
    step, obstacle, tilt = event_axes(figure)
    assert [ax.get_title().split(":")[0] for ax in (step, obstacle, tilt)] == list(EVENTS)
    assert paths(step) == {"unknown": 6, "failed": 10, "safe": 20}
    assert paths(obstacle) == {"unknown": 6, "failed": 30}
    assert paths(tilt) == {"unknown": 6, "safe": 30}
    image = pixels(figure, tmp_path)
    for ax, shown in ((step, {"failed", "safe"}), (obstacle, {"failed"}), (tilt, {"safe"})):
        for kind in ("failed", "safe"):
            assert (count_of(within(ax, image), kind) > 100) == (kind in shown)


def test_the_failed_trajectories_are_the_ones_that_turn_red():
    failed, known = np.zeros((1, 36, 3), bool), np.ones((1, 36), bool)
    failed[0, FEW.index(1, 0, 2), 0] = True
    ax = event_axes(labelled(failed, known))[0]
    red = next(lines for lines in ax.collections if to_hex(lines.get_colors()[0]) == map_figures.FAILED)
    np.testing.assert_allclose(red.get_segments()[0], FEW.poses(FEW.index(1, 0, 2))[:, :2], rtol=0, atol=1e-12)


def test_failed_trajectories_lie_on_top():
    failed, known = np.zeros((1, 36, 3), bool), np.ones((1, 36), bool)
    failed[0, :5] = True
    known[0, 30:] = False
    lines = [to_hex(lines.get_colors()[0]) for lines in event_axes(labelled(failed, known))[0].collections]
    assert lines[-1] == map_figures.FAILED


def test_shares_stand_over_each_event():
    failed, known = np.zeros((1, 36, 3), bool), np.ones((1, 36), bool)
    known[0, :16] = False
    failed[0, 16:21, 1] = True
    shown = titles(labelled(failed, known))
    assert "obstacle: 25.0% of known fail" in shown
    assert "tilt: 0.0% of known fail" in shown
    assert "map 0" in shown


def test_the_legend_names_the_three_kinds():
    figure = labelled(np.zeros((1, 36, 3), bool), np.ones((1, 36), bool))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["safe", "failed", "unknown"]


@pytest.mark.parametrize("all_nan", [True, False])
def test_a_map_that_is_all_unknown_draws(tmp_path, all_nan):
    heights = np.full((1, *GRID.shape), np.nan if all_nan else 0.0, np.float32)
    figure = labelled(np.zeros((1, 36, 3), bool), np.zeros((1, 36), bool), heights)
    image = pixels(figure, tmp_path)
    for ax, event in zip(event_axes(figure), EVENTS, strict=True):
        assert ax.get_title() == f"{event}: all unknown"
        assert paths(ax) == {"unknown": 36}
        assert count_of(within(ax, image), "failed") == count_of(within(ax, image), "safe") == 0
        assert colours(within(ax, image)) > 10


def test_several_maps_stand_below_each_other_each_with_its_own_heights_and_labels(tmp_path):
    failed, known = np.zeros((3, 36, 3), bool), np.ones((3, 36), bool)
    failed[0] = True
    known[2] = False
    heights = np.random.default_rng(0).standard_normal((3, *GRID.shape)) * [[[0.1]], [[1]], [[10]]]
    figure = labelled(failed, known, heights.astype(np.float32))
    pixels(figure, tmp_path)
    kinds = [set(paths(ax)) for ax in event_axes(figure)]
    assert kinds == [{"failed"}] * 3 + [{"safe"}] * 3 + [{"unknown"}] * 3
    elevations = [ax for ax in figure.axes if ax.get_title().startswith("map ")]
    assert [ax.get_title() for ax in elevations] == [f"map {number}" for number in range(3)]
    for ax, one in zip(elevations, heights, strict=True):
        np.testing.assert_allclose(ax.images[0].get_array(), one, rtol=1e-6)


def test_all_of_the_papers_trajectories_are_drawn(tmp_path):
    actions = ActionSpace()
    failed = np.random.default_rng(0).random((1, len(actions), 3)) < 0.1
    figure = labelled(failed, np.ones((1, len(actions)), bool), actions=actions)
    assert colours(pixels(figure, tmp_path)) > 500
    assert sum(paths(event_axes(figure)[0]).values()) == 3042
    assert figure.get_suptitle() == "3042 trajectories of Seekur Jr, contact model nearest"


def test_failing_paths_are_failed_from_the_pose_where_their_margin_is_reached():
    failed = np.zeros((1, 36, 3), bool)
    failed[0, 4, 1] = failed[0, 5, 1] = True
    poses = np.zeros((1, 36, 3), int)
    poses[0, 4, 1], poses[0, 5, 1] = 3, -2  # on an arc, and in a point turn
    heights = np.zeros((1, *GRID.shape))
    figure = map_figures.labelled_maps(heights, failed, np.ones((1, 36), bool), ["flat"], SETUP, poses)
    last = event_axes(figure)[1].collections[-1]
    assert to_hex(last.get_colors()[0]) == map_figures.FAILED
    count = SETUP.actions.poses(0).shape[0]
    assert [len(path.vertices) for path in last.get_paths()] == [count - 3, count]


# ---- Predicted maps


def predicted(probabilities: np.ndarray, failed: np.ndarray, known: np.ndarray) -> Figure:
    """The figure of maps of random ground, on few actions."""
    heights = np.random.default_rng(0).standard_normal((len(failed), *GRID.shape)).astype(np.float32)
    names = [f"map {number}" for number in range(len(failed))]
    return map_figures.predicted_maps(heights, {"predicted": probabilities}, failed, known, names, SETUP)


def of_event(figure: Figure, event: str) -> tuple:
    """The axes with the predictions of an event, and those with the truth, of all maps in turn."""
    shown = [ax for ax in figure.axes if ax.get_title().startswith(f"{event}, ")]
    return [ax for ax in shown if "predicted" in ax.get_title()], [ax for ax in shown if "true" in ax.get_title()]


def test_predictions_have_three_colours_over_the_truth_with_two_and_unknown(tmp_path):
    probabilities, failed, known = np.zeros((1, 36, 3)), np.zeros((1, 36, 3), bool), np.ones((1, 36), bool)
    probabilities[0, :, 0] = np.repeat([0.0, 0.2499, 0.25, 0.4999, 0.5, 1.0], [10, 5, 4, 3, 2, 12])
    probabilities[0, :, 1] = 0.3
    probabilities[0, :, 2] = 0.9
    failed[0, 30:, 0] = failed[0, :, 2] = True
    known[0, :8] = False
    failed[0, :8] = False
    figure = predicted(probabilities, failed, known)
    image = pixels(figure, tmp_path)
    drawn = {event: [paths(ax) for (ax,) in of_event(figure, event)] for event in EVENTS}
    assert drawn == {
        "step": [{"unknown": 8, "safe": 7, "doubtful": 7, "failed": 14}, {"unknown": 8, "safe": 22, "failed": 6}],
        "obstacle": [{"unknown": 8, "doubtful": 28}, {"unknown": 8, "safe": 28}],
        "tilt": [{"unknown": 8, "failed": 28}, {"unknown": 8, "failed": 28}],
    }
    (above,), (below,) = of_event(figure, "step")
    assert above.get_title() == "step, predicted: 50.0% of known fail"
    assert below.get_title() == "step, true: 21.4% of known fail"
    assert above.get_window_extent().y0 > below.get_window_extent().y1
    for ax in (above, below):
        assert count_of(within(ax, image), "failed") > 100
        assert count_of(within(ax, image), "safe") > 100


def test_several_predictions_stand_below_each_other_and_the_truth_is_last(tmp_path):
    known, failed = np.ones((2, 36), bool), np.zeros((2, 36, 3), bool)
    failed[1] = True
    before, after = np.full((2, 36, 3), 0.9), np.full((2, 36, 3), 0.1)
    heights = np.zeros((2, *GRID.shape), np.float32)
    names, predictions = ["one", "two"], {"before": before, "after": after}
    figure = map_figures.predicted_maps(heights, predictions, failed, known, names, SETUP)
    pixels(figure, tmp_path)
    shown = [ax for ax in figure.axes if ax.get_title().startswith("tilt, ")]
    assert [ax.get_title().split(":")[0] for ax in shown] == ["tilt, before", "tilt, after", "tilt, true"] * 2
    assert [*map(paths, shown)] == [{"failed": 36}, {"safe": 36}, {"safe": 36}] + [
        {"failed": 36},
        {"safe": 36},
        {"failed": 36},
    ]
    assert sorted(shown, key=lambda ax: -ax.get_window_extent().y0) == shown


def test_every_so_many_trajectories_are_said_to_be_that():
    shown, known = np.zeros((1, 8, 3)), np.ones((1, 8), bool)
    heights = np.zeros((1, *GRID.shape), np.float32)
    settings = (["one"], SETUP)
    figure = map_figures.predicted_maps(
        heights, {"predicted": shown}, shown > 1, known, *settings, "simulator", every=5
    )
    assert figure.get_suptitle() == "8 of the 36 trajectories of Seekur Jr"
    above, below = (ax for ax in figure.axes if ax.get_title().startswith("step, "))
    assert below.get_title() == "step, simulator: 0.0% of known fail"
    lines = next(lines for lines in above.collections if len(lines.get_segments()))
    np.testing.assert_allclose(lines.get_segments(), FEW.poses(np.arange(0, 36, 5))[..., :2], rtol=0, atol=1e-12)


def test_the_trajectory_that_is_predicted_to_fail_turns_red():
    probabilities = np.zeros((1, 36, 3))
    probabilities[0, FEW.index(3, 2, 1), 1] = 0.8
    (ax,), _ = of_event(predicted(probabilities, probabilities > 1, np.ones((1, 36), bool)), "obstacle")
    red = ax.collections[-1]
    assert to_hex(red.get_colors()[0]) == map_figures.FAILED
    np.testing.assert_allclose(red.get_segments()[0], FEW.poses(FEW.index(3, 2, 1))[:, :2], rtol=0, atol=1e-12)


def test_predicted_maps_stand_below_each_other_each_with_its_own_predictions(tmp_path):
    probabilities = np.stack([np.full((36, 3), level) for level in (0.1, 0.3, 0.7)])
    failed, known = np.zeros((3, 36, 3), bool), np.ones((3, 36), bool)
    failed[1] = True
    known[2] = False
    figure = predicted(probabilities, failed, known)
    pixels(figure, tmp_path)
    for event in EVENTS:
        above, below = of_event(figure, event)
        assert [set(paths(ax)) for ax in above] == [{"safe"}, {"doubtful"}, {"unknown"}]
        assert [set(paths(ax)) for ax in below] == [{"safe"}, {"failed"}, {"unknown"}]
        assert [ax.get_title() for ax in (above[2], below[2])] == [
            f"{event}, predicted: all unknown",
            f"{event}, true: all unknown",
        ]
    elevations = [ax for ax in figure.axes if ax.get_title().startswith("map ")]
    assert [ax.get_title() for ax in elevations] == ["map 0", "map 1", "map 2"]
    (legend,) = [ax.get_legend() for ax in figure.axes if ax.get_legend()]
    assert len(legend.get_texts()) == 4


# ---- Robot and action space


@pytest.mark.parametrize("preset", Robot.presets())
def test_the_robot_is_drawn_with_its_dimensions(tmp_path, preset):
    robot = Robot.load(preset)
    figure = map_figures.robot_figure(robot)
    assert colours(pixels(figure, tmp_path)) > 50
    texts = " ".join(text.get_text().replace("\n", " ") for ax in figure.axes for text in ax.texts)
    for name, length in {
        "track": robot.track,
        "wheelbase": robot.wheelbase,
        "chassis width": robot.chassis_width,
        "chassis length": robot.chassis_length,
        "ride height": robot.ride_height,
        "largest step": robot.max_step,
        "wheel diameter": robot.wheel_diameter,
    }.items():
        assert f"{name} {length:.3f} m" in texts
    assert f"{math.degrees(robot.max_tilt):.1f} deg" in " ".join(titles(figure))
    assert figure.get_suptitle() == robot.name


def test_the_robot_is_drawn_to_scale():
    plan, side = map_figures.robot_figure(SEEKUR_JR).axes
    assert plan.get_aspect() == side.get_aspect() == 1
    wheels = [patch for patch in plan.patches if to_hex(patch.get_facecolor()) == "#000000"]
    boxes = sorted((*patch.get_xy(), patch.get_width(), patch.get_height()) for patch in wheels)
    expected = [(x - 0.172 / 2, y - 0.4 / 2, 0.172, 0.4) for x in (-0.663 / 2, 0.663 / 2) for y in (-0.2125, 0.2125)]
    np.testing.assert_allclose(boxes, expected, rtol=0, atol=1e-12)
    for ax in (plan, side):
        for patch in ax.patches:
            box = patch.get_path().transformed(patch.get_patch_transform()).get_extents()
            assert ax.get_xlim()[0] <= box.xmin < box.xmax <= ax.get_xlim()[1]
            assert ax.get_ylim()[0] <= box.ymin < box.ymax <= ax.get_ylim()[1]


@pytest.mark.parametrize("actions", [ActionSpace(), FEW, ActionSpace(turns=1, radii=(math.inf,))], ids=len)
def test_the_action_space_is_drawn_whole_and_after_one_turn(tmp_path, actions):
    figure = map_figures.action_figure(Setup(SEEKUR_JR, actions, GRID))
    assert colours(pixels(figure, tmp_path)) > 50
    whole, fan = figure.axes
    radii = len(actions.radii)
    assert [len(lines.get_segments()) for lines in whole.collections] == [len(actions)]
    assert [len(lines.get_segments()) for lines in fan.collections] == [radii**2, radii]
    assert [text.get_text() for text in whole.texts if text.get_text()] == [
        f"{360 * k / actions.turns:.0f}" for k in range(actions.turns)
    ]
    for ax in (whole, fan):
        points = np.concatenate([np.concatenate(lines.get_segments()) for lines in ax.collections])
        assert np.abs(points).max() < ax.get_xlim()[1] == ax.get_ylim()[1] == GRID.size / 2


# ---- Speed


def speed_row(what: str, maps: int, ms_per_map: float | None) -> dict:
    return {"what": what, "maps": maps, "ms_per_map": ms_per_map}


def test_speeds_are_drawn_against_the_number_of_maps(tmp_path):
    rows = [speed_row("terrain", 1, 5.0), speed_row("labelling", 1, 8.0), speed_row("terrain", 8, 2.0)]
    figure = map_figures.speed_figure([*rows, speed_row("labelling", 32, 1.0), speed_row("nothing", 1, None)])
    assert colours(pixels(figure, tmp_path)) > 50
    (ax,) = figure.axes
    lines = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in ax.lines}
    assert lines == {"terrain": ([1, 8], [5.0, 2.0]), "labelling": ([1, 32], [8.0, 1.0])}
    assert ax.get_xscale() == ax.get_yscale() == "log"
