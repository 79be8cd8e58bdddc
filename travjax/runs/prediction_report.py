"""Predictions for maps by a trained estimator, as a file of arrays, a table and a figure."""

from collections.abc import Callable, Sequence
from pathlib import Path

from travjax import progress
from travjax.data.map_batches import Batch, MapStream, bytes_each, labelled, samples, title
from travjax.evaluation import metrics, tables
from travjax.files import output_folder, save_text
from travjax.npz_stream import NpzStream
from travjax.runs.predictor import Predictor

PROBABILITY = 0.5
"""Probability from which a trajectory counts as failing in the printed table."""

SIMULATOR = "simulator\non the map as given"
"""Label of the row below the predictions in a figure."""

AGAINST = "Against the simulator on the map as given, its noise included"
"""Heading of the table that `--check` prints."""


def predict_maps(
    maps: MapStream, predictor: Predictor, out: str | Path, check: bool = False, figures: bool = True
) -> Path:
    """Predicts failures on maps, prints the shares that fail, and writes predictions, shares and a figure.

    check: whether to compare the predictions with the simulator on the maps as given
    Returns the .npz of the predictions. Raises InputError when they do not fit on the disk, or cannot be written.
    """
    folder, trained = output_folder(out), predictor.run
    model, setup, robot, actions = trained.preset.model, trained.setup, trained.robot, trained.actions
    config = setup.to_json_text(files=maps.files, model=model, world=maps.world)
    size = bytes_each(setup) + len(actions) * len(robot.events) * 2 * 4
    with NpzStream(folder / "predictions.npz", maps.total, size, "predicted maps") as predictions:
        with progress.bar("predicting", maps.total * len(actions), "trajectory") as bar:
            for batch in maps.batches:
                predictions.append(_predicted(batch, predictor, bar.update))
        arrays = predictions.arrays
        fails = arrays["probability"] >= PROBABILITY
        table = tables.shares_table(arrays["group"], fails, arrays["known"], False, robot.event_names)
        text = f"Predicted to fail, {robot.name}, {len(actions)} trajectories a map, {model}:\n{table}"
        if check:
            text += f"\n\n{_checked(arrays, robot.event_names)}"
        unsaved = ("heights",) if check else ("heights", "failed")
        saved = predictions.save(unsaved, config=config, cell_size=trained.grid.spacing)
        shares = save_text(folder / "shares.txt", f"{text}\n")
        progress.say(f"\n{text}\n")
        progress.wrote(saved, shares)
        if figures:
            progress.wrote(_figure(arrays, predictor, check, folder))
    return saved


def _predicted(batch: Batch, predictor: Predictor, on_progress: Callable[[int], object]) -> Batch:
    """Adds the predictions to a batch, and from the simulator the failures and which trajectories are known."""
    trained = predictor.run
    simulated = labelled(batch, trained.setup)
    predicted = predictor.predict(batch["heights"], on_progress)
    kept = ("heights", "group", "known", "failed", "origin", "height_offset", "crs", "seed")
    found = {name: simulated[name] for name in kept if name in simulated} | {"probability": predicted.probability}
    if predicted.margins is not None:
        found |= {
            f"margin_{name}": predicted.margins[..., event] for event, name in enumerate(trained.robot.event_names)
        }
    return found


def _checked(maps: Batch, events: Sequence[str]) -> str:
    """Compares predictions with the simulator on the maps as given; on noisy maps that is not the true ground."""
    known = maps["known"]
    scores = metrics.evaluate(maps["probability"][known], maps["failed"][known], events=events)
    return f"{AGAINST}:\n{tables.metrics_table(scores, None)}"


def _figure(maps: Batch, predictor: Predictor, check: bool, out: Path) -> Path:
    """Draws which trajectories of a few maps are safe, doubtful or failing; `check` adds a row by the simulator."""
    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    shown, trained = samples(maps), predictor.run
    titles = [title(maps, index) for index in shown]
    figure = map_figures.predicted_maps(
        maps["heights"][shown],
        {"predicted": maps["probability"][shown]},
        maps["failed"][shown] if check else None,
        maps["known"][shown],
        titles,
        trained.setup,
        SIMULATOR,
    )
    return map_figures.save(figure, out / "predictions.png")
