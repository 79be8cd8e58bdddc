"""What the tests share: varied maps, setups, and the `gpu` marker.

Tests run on the CPU; those marked `gpu` run with `JAX_PLATFORMS=cuda,cpu pytest -m gpu`.

Compiled code is kept in a folder that the processes of a session share, and the sessions after it: most of the tests'
time is XLA's, and it compiles many programs several times. Code is found again by the program itself, its options and
the version of XLA, so what has changed is compiled anew. XLA optimises as it does for users: BUILD_NOTES.md (failed
trials: commands and what programs share) says what less of it would save.
"""

import gc
import math
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from tests.commandline import FEW_TOML
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import STYLES, generate_terrain

# A runner in the background ignores interrupts, and so would the programs that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

if "JAX_PLATFORMS" not in os.environ:
    jax.config.update("jax_platforms", "cpu")

hypothesis.settings.register_profile("travjax", deadline=None, max_examples=25, derandomize=True)
hypothesis.settings.load_profile("travjax")

# Tracing makes many objects and few cycles: to look for these less often saves a twentieth of the tests' time.
gc.set_threshold(20_000, 20, 20)


LONGEST = [
    *("commands/test_train.py", "traversal/test_tyre.py", "traversal/test_traverse.py", "test_cli.py"),
    *("experiments/test_gpu.py", "test_jax_flags.py", "test_docs.py", "experiments/test_transfer.py"),
    *("runs/test_predictor.py", "resnet/test_convolution.py", "resnet/test_imagenet_weights.py"),
    *("training/test_trainer.py", "site/test_kernel.py", "site/test_mapping.py", "simulation/test_events.py"),
    "commands/test_evaluate.py",
    *("resnet/test_network.py", "physics/test_physics.py", "terrain/test_styles.py", "commands/test_predict.py"),
    *("estimators/test_map_estimator.py", "runs/test_checkpoint.py", "test_wheel.py", "planning/test_oracle.py"),
    *("models/test_input_images.py", "evaluation/test_map_figures.py", "test_examples.py"),
]
"""Files of 20 s or more. They go first, so that workers that take a file at a time end at about the same time."""


SLOW = {
    "commands/test_train.py": (
        "test_two_processes_of_two_devices",
        "test_a_run_that_was_interrupted_and_killed_ends_like",
    ),
    "experiments/test_gpu.py": (
        "test_a_part_that_runs_out_of_time",
        "test_all_parts_are_finished",
        "test_everything_small_lies_in_the_folder",
        "test_the_report_says_how_far",
    ),
    "experiments/test_transfer.py": ("test_without_real_maps_it_runs_on_stand_ins",),
    "experiments/test_transfer_runs.py": ("test_without_frozen_trunks_everything_is_trained",),
    "physics/test_physics.py": ("test_the_experiment_runs_and_goes_on",),
    "planning/test_oracle.py": (
        "test_a_bank_is_crossed_straight_where_a_slant_would_turn_the_robot_over[tyre]",
        "test_a_start_that_is_the_goal[tyre]",
    ),
    "resnet/test_convolution.py": ("test_four_devices_find", "test_the_gradient_of_a_resnet_is"),
    "resnet/test_imagenet_weights.py": (
        "test_every_stage_of_a_converted_network_is_that_of_torch",
        "test_another_epsilon_of_the_network_leaves_its_function",
    ),
    "resnet/test_network.py": ("test_every_stage_agrees_with_float64",),
    "runs/test_checkpoint.py": ("test_a_kill_at_any_moment_loses_no_checkpoint",),
    "runs/test_model_file.py": ("test_no_bit_that_turned_over_gives_another_estimator",),
    "runs/test_predictor.py": ("test_a_resnet_is_loaded_from_its_run",),
    "simulation/test_events.py": (
        "test_training_scores_the_four_events",
        "test_evaluation_has_tables_and_figures_of_the_four_events",
        "test_predictions_have_a_probability_of_roll",
    ),
    "site/test_kernel.py": (
        "test_at_the_middle_of_a_map_a_primitive_is_a_trajectory[tyre]",
        "test_bits_do_not_depend_on_the_tiles[tyre]",
        "[mars_live_site",
    ),
    "site/test_mapping.py": ("test_a_cluster_makes_the_same_map",),
    "terrain/test_styles.py": ("test_the_maps_are_the_same_where_float64_is_enabled",),
    "test_cli.py": (
        "test_rock_fields_are_labelled_and_not_compared_with_the_paper",
        "test_the_program_labels_and_a_second_start_compiles_nothing_anew",
        "test_a_world_makes_the_same_ground_on_a_larger_map_and_is_recorded[label]",
        "test_a_world_makes_the_same_ground_on_a_larger_map_and_is_recorded[dataset]",
    ),
    "test_docs.py": tuple(
        f"test_python_of_a_page_runs_and_prints_what_it_says[docs/{page}.md]"
        for page in ("training", "plans", "site-maps")
    ),
    "test_examples.py": ("test_a_field_is_trained_and_compared", "test_a_figure_of_the_paper_is_drawn"),
    "test_fuzz.py": ("test_a_damaged_file_gives", "test_the_short_campaign_gets"),
    "test_jax_flags.py": ("test_a_run_is_the_same_and_goes_on", "test_a_fresh_process_under_all_flags"),
    "training/test_trainer.py": ("test_a_narrow_trunk_learns_32_samples_by_heart",),
    "traversal/test_traverse.py": ("[unpaired radii-7]", "[fine large map-7]", "[coarse small map-7]"),
    "traversal/test_tyre.py": (
        *("[Husky, odd turns]", "[without turns, fine]"),
        *(f"test_a_plane_has_no_step_its_own_tilt_and_no_obstacle[{spacing}" for spacing in (0.04, 0.1)),
    ),
}
"""Parts of names of tests that take long and check on other input, or as a whole, what quicker tests check too.

`make test` leaves them out, `make test-all` does not.
"""


def file_of(item) -> str:
    """The file of a test, from this folder on."""
    return item.path.relative_to(Path(__file__).parent).as_posix()


def place_of(item) -> int:
    """Where the file of a test stands among LONGEST, or behind them."""
    file = file_of(item)
    return LONGEST.index(file) if file in LONGEST else len(LONGEST)


MOST_COMPILED_CODE = 1 << 30
"""Bytes; a session that finds more begins with an empty folder."""


def compiled_code(config) -> str:
    """The folder of compiled code, under .pytest_cache, which `make clean` and `pytest --cache-clear` remove."""
    if not hasattr(config, "cache"):  # -p no:cacheprovider
        return tempfile.mkdtemp(prefix="travjax-tests-")
    folder = config.cache.mkdir("compiled-code")
    if sum(path.stat().st_size for path in folder.iterdir()) > MOST_COMPILED_CODE:
        shutil.rmtree(folder)
    return str(folder)


def pytest_configure(config):
    if not hasattr(config, "workerinput"):  # workers of pytest-xdist, and programs that tests start, inherit the folder
        os.environ["JAX_COMPILATION_CACHE_DIR"] = compiled_code(config)
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput") and not hasattr(config, "cache"):
        shutil.rmtree(os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)


def group_files(items) -> None:
    """Marks tests with the group that a worker takes as a whole: their file, or all files that use `trained`."""
    training = {item.path for item in items if "trained" in item.fixturenames}
    for item in items:
        item.add_marker(pytest.mark.xdist_group("trained" if item.path in training else str(item.path)))


@pytest.hookimpl(tryfirst=True)  # pytest-xdist reads the groups in its own hook
def pytest_collection_modifyitems(items):
    items.sort(key=place_of)
    group_files(items)
    for item in items:
        if any(part in item.name for part in SLOW.get(file_of(item), ())):
            item.add_marker(pytest.mark.slow)
    if jax.default_backend() != "gpu":
        skip = pytest.mark.skip(reason=f"needs a GPU, and JAX runs on {jax.default_backend()} here")
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session")
def maps() -> dict[str, np.ndarray]:
    """Seven maps, [129, 129] float32 metres: one of every style, a steep rough one, and a bumpy one with holes.

    The seeds are chosen so that on every map some trajectories fail and some do not.
    """
    synthetic = np.asarray(generate_terrain(STYLES, [4, 7, 9, 4, 20]))
    y, x = np.meshgrid(Grid().axis(), Grid().axis(), indexing="ij")
    noise = np.random.default_rng(0).standard_normal((2, *Grid().shape))
    steep = 0.64 * x - 0.2 * y + 0.012 * noise[0]
    holes = 0.1 * np.sin(2 * x) * np.cos(3 * y) + 0.01 * noise[1]
    holes[np.hypot(x - 1.5, y - 1.5) < 0.4] = np.nan
    holes[[110, 20, 70], [60, 61, 10]] = np.nan
    named = dict(zip(STYLES, synthetic, strict=True)) | {"steep": steep, "holes": holes}
    return {name: heights.astype(np.float32) for name, heights in named.items()}


MAP_NAMES = (*STYLES, "steep", "holes")


@pytest.fixture(scope="session", params=MAP_NAMES)
def map_name(request) -> str:
    """The name of each of the maps in turn."""
    return request.param


SEEKUR_JR, HUSKY, LEO_ROVER = map(Robot.load, ("seekur_jr", "husky_a200", "leo_rover"))
STRAIGHT = (math.inf,)
CELL = Grid().spacing

TIES = replace(SEEKUR_JR, track=9 * CELL, wheelbase=7 * CELL, chassis_width=6 * CELL, chassis_length=16 * CELL)
"""Where its centre is on a node and it faces along an axis, wheels are midway between nodes, chassis edges on nodes."""

SETUPS = {
    "paper": Setup(SEEKUR_JR, ActionSpace()),
    "odd number of turns": Setup(HUSKY, ActionSpace(turns=5, interval=0.11)),
    "unpaired radii": Setup(LEO_ROVER, ActionSpace(turns=6, radii=(math.inf, 1.5, -0.9), interval=0.1)),
    "odd turns and unpaired radii": Setup(SEEKUR_JR, ActionSpace(turns=3, radii=(1.5, math.inf, 4.0), interval=0.08)),
    "arcs of different length": Setup(
        HUSKY, ActionSpace(turns=2, arc_lengths=(1.0, 2.2), radii=(-1.2, math.inf, 1.2), interval=0.15)
    ),
    "ties and quarter circles": Setup(
        TIES,
        ActionSpace(
            turns=4,
            radii=(math.inf, 16 * CELL, -16 * CELL),
            arc_lengths=(8 * math.pi * CELL, 24 * CELL),
            interval=2 * CELL,
        ),
    ),
    "ties on and between nodes": Setup(
        TIES, ActionSpace(turns=4, radii=STRAIGHT, arc_lengths=(8 * CELL, 12 * CELL), interval=CELL / 2)
    ),
    "coarse small map": Setup(
        HUSKY,
        ActionSpace(turns=4, arc_lengths=(0.6, 0.5), radii=(math.inf, 0.7, -0.7), interval=0.1),
        Grid(4, 0.125),
    ),
    "fine large map": Setup(SEEKUR_JR, ActionSpace(turns=8, radii=(math.inf, 2.0, -2.0), interval=0.1), Grid(10, 0.05)),
    "chassis without four nodes in a row": Setup(
        replace(SEEKUR_JR, chassis_width=0.1, chassis_length=0.1),
        ActionSpace(turns=4, radii=(math.inf, 1.5, -1.5), interval=0.1),
    ),
    "chassis with four nodes in some rows": Setup(
        replace(SEEKUR_JR, chassis_width=0.2, chassis_length=0.3),
        ActionSpace(turns=4, radii=(math.inf, 1.5, -1.5), interval=0.1),
    ),
    "chassis of few nodes": Setup(
        replace(SEEKUR_JR, chassis_width=0.3, chassis_length=0.2), ActionSpace(turns=2, radii=STRAIGHT, interval=0.1)
    ),
    "chassis with four nodes in all rows": Setup(
        SEEKUR_JR, ActionSpace(turns=1, radii=STRAIGHT, arc_lengths=(0.5, 0.5), interval=0.5)
    ),
    "chassis longer than 127 nodes": Setup(
        replace(SEEKUR_JR, chassis_length=2.1),
        ActionSpace(turns=2, radii=STRAIGHT, arc_lengths=(0.2, 0.2), interval=0.2),
        Grid(4, 1 / 128),
    ),
}
"""Setups that take different ways through the tables and the kernel."""


@pytest.fixture(scope="module", params=SETUPS)
def setup(request) -> Setup:
    """Each of the setups in turn."""
    return SETUPS[request.param]


@pytest.fixture(scope="session")
def few(tmp_path_factory) -> Path:
    """A small action space, commandline.FEW, as a TOML file."""
    path = tmp_path_factory.mktemp("actions") / "few.toml"
    path.write_text(FEW_TOML)
    return path


@pytest.fixture(scope="session")
def shared_code() -> Iterator[None]:
    """Trainers of the same settings of the optimizer share compiled code."""
    from travjax.estimators.preset import TrainingConfig

    make, made = TrainingConfig.make_optimizer, {}

    def make_optimizer(config, phase, steps):
        steps = steps if config.schedule == "cosine" else 1
        names = ("optimizer", "learning_rate", "decay", "epsilon", "max_grad_norm", "schedule", "warmup_steps")
        own = config.weight_decay if config.optimizer == "adamw" else None
        key = (phase, steps, own, *(getattr(config, name) for name in names))
        return made.setdefault(key, make(config, phase, steps))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingConfig, "make_optimizer", make_optimizer)
        yield


@pytest.fixture(scope="session")
def trained(tmp_path_factory, few, shared_code) -> Path:
    """The folder of a finished run of `travjax train`; beside it are `set`, `tiny.toml`, `out.txt` and `err.txt`."""
    from tests.small_training import files_of_run, train, words_of

    folder = tmp_path_factory.mktemp("trained")
    out, err = train((*words_of(files_of_run(folder), few), "--out", folder / "run"))
    (folder / "out.txt").write_text(out)
    (folder / "err.txt").write_text(err)
    return folder / "run"


@pytest.fixture(scope="session")
def field(tmp_path_factory, shared_code) -> Path:
    """The folder of a short run of a tiny hazard field."""
    from tests.field_runs import begun

    folder = tmp_path_factory.mktemp("field") / "run"
    begun(folder, epochs=2).train()
    return folder
