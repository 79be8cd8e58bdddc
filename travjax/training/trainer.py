"""Trains in two phases (SPEC section 9): the heads on the features of the frozen trunk, then everything.

All random numbers follow from the training seed and the step, so a run that was interrupted continues as if it had not
been. A step is in step.py; the estimator's kind (estimators/kind.py) defines the loss and the training data.
"""

import math
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from travjax import progress
from travjax.config import InputError, one_line, require
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples
from travjax.devices import Devices
from travjax.estimators.inference import NoNumbers, Placed, probabilities
from travjax.estimators.kind import Batch, Phase
from travjax.evaluation import metrics
from travjax.files import held
from travjax.jax_flags import usual_flags
from travjax.models.variables import VARIABLES, Network, Variables, split_model
from travjax.runs.checkpoint import Checkpoints
from travjax.runs.run import Run, checked_meta
from travjax.runs.run_log import RunLog
from travjax.training.step import State, StepSettings, is_finite, update
from travjax.training.trunk_features import Features, kept, origin_of

IN_FLIGHT = 2
"""Steps whose loss the host has not read yet: the device works while the host prepares the next batch."""

REPORTS = 20
"""Number of training-loss rows logged in an epoch."""


@dataclass
class Position:
    """Where training stands; together with the state, all that is needed to resume.

    phase: 1 or 2; epoch: within the phase; step: within the epoch; total: number of steps over all epochs
    loss, samples: sums over the epoch so far; best: largest overall average precision on validation so far
    """

    phase: int = 1
    epoch: int = 0
    step: int = 0
    total: int = 0
    loss: float = 0.0
    samples: float = 0.0
    best: float = -1.0


class Trainer:
    """One training run.

    data: what is trained on; state: that of step.py; position: where it stands
    eval_sets: named samples on which each epoch is scored beside the validation, and the first state; training does not
        depend on them
    features: file that keeps the features of the frozen trunk, for this run resumed or others of the same trunk and
        samples; they are kept in memory only where it is None, and where several processes train
    Raises InputError when the data set is not for the run's robot, action space and grid, when it has no training or no
    validation samples, or when the devices cannot share a batch.
    """

    def __init__(
        self,
        run: Run,
        dataset: Dataset,
        folder: Path,
        devices: Devices,
        quiet: bool = False,
        eval_sets: Mapping[str, Samples] | None = None,
        features: Path | None = None,
    ):
        dataset.setup.require_same(run.setup, "data set")
        devices.check_batch(run.preset.training.batch_size)
        self.run, self.folder, self.devices = run, folder, devices
        self.kind, self.config = run.kind, run.preset.training
        self.data = self.kind.data(run.preset, dataset)
        self.quiet = quiet or not devices.main
        self.scored = {"validation": self.data.validation} | dict(eval_sets or {})
        self.checkpoints = Checkpoints(folder / "checkpoints")
        self.position = Position()
        self._features_file = features if jax.process_count() == 1 else None
        self._optimizers: dict[int, optax.GradientTransformation] = {}
        self.graph = run.graph()
        self.log: RunLog | None = None

    @cached_property
    def source(self) -> Any:
        """The maps in the form the estimator takes, on the devices."""
        with self._bar("trajectory bank", len(self.run.actions), "trajectory") as bar:
            source = self.run.source(self.data.dataset.heights, bar.update)
        return self.devices.replicate(source)

    @property
    def phase(self) -> Phase:
        """The definition of the present phase."""
        return self.kind.phases[self.position.phase]

    @cached_property
    def features(self) -> Features:
        """The features of a frozen trunk by the names of the samples, computed unless the file of them has them."""
        frozen, samples = self.phase.frozen_trunk, {"training": self.data.samples(1, 0)} | self.scored
        assert frozen, "only asked for in a phase with a frozen trunk"
        compute = lambda: {
            name: self._over(frozen.features, part, f"{name} features") for name, part in samples.items()
        }
        if self._features_file is None:
            return compute()
        origin = origin_of(self.run, self.data.dataset.fingerprint, self._variables, samples)
        return kept(self._features_file, origin, compute)

    @usual_flags()
    def start(self, estimator: Network) -> None:
        """Starts from an estimator; phase 1 leaves its trunk unchanged."""
        variables = jax.tree.map(jax.numpy.copy, split_model(estimator)[1])  # steps reuse the memory of the state
        self.state: State = self.devices.replicate(variables)
        self._begin(1 if self.config.head_epochs else 2)

    @usual_flags()
    def resume(self) -> None:
        """Resumes from the latest intact checkpoint; a damaged one is skipped with a notice.

        Raises InputError when there is none, or when it was trained on another data set.
        """
        optimizer = lambda meta: checked_meta(meta, self.folder)["optimizer"]
        template = lambda meta: self.run.template(optimizer(meta), self.devices.everywhere)
        self.state, meta = self.checkpoints.restore(template)
        trained_on, given = meta["dataset"], self.data.dataset.fingerprint
        require(trained_on == given, "data set", given, f"{trained_on}, the one that the run was trained on so far")
        self.position = Position(**meta["position"])
        for notice in self.checkpoints.notices:
            self._say(one_line(notice))
        here = self.position
        self._say(f"goes on from step {here.total}: phase {here.phase}, epoch {here.epoch + 1}, batch {here.step + 1}")

    @usual_flags()
    def train(self, until: float = math.inf) -> bool:
        """Trains from the present position to the end, with a checkpoint at regular steps and after each epoch.

        until: `time.monotonic()` after which no step begins: the last one is saved in a checkpoint; in one process only
        Returns whether training has reached its end.
        Raises InputError when another process works in the folder, and when the loss becomes NaN or infinite; the last
        checkpoint is kept.
        """
        with held(self.folder) if self.devices.main else nullcontext():
            self._train(until)
        return self.finished

    @property
    def finished(self) -> bool:
        """Whether all epochs are trained."""
        return self.position.phase == 2 and self.position.epoch == self.config.epochs

    def _train(self, until: float) -> None:
        if self.devices.main:
            self.log = RunLog(self.folder, self.position.total)
        try:
            if not self.position.total and (row := self._eval_scores()) and self.log:
                self.log.write({"step": 0, "phase": self.position.phase, "epoch": 0} | row)
            while not self.finished and time.monotonic() < until:
                if self.position.phase == 1 and self.position.epoch == self.config.head_epochs:
                    self.checkpoints.save_named("heads", self._variables, self._meta(optimizer=0))
                    self._begin(2)
                else:
                    self._train_epoch(until)
        finally:
            if self.log:
                self.log.close()

    def _begin(self, phase: int) -> None:
        """Begins a phase with a new optimizer for the parts that it trains."""
        self.position.phase, self.position.epoch = phase, 0
        self.__dict__.pop("features", None)  # they take gigabytes for a large data set
        trained = {name: self.state[name] for name in self.phase.trained}
        optimizer = self.devices.replicate(self._optimizer(phase).init(trained))
        self.state = self._variables | {"optimizer": optimizer}

    @property
    def _variables(self) -> Variables:
        """The state without its optimizer."""
        return {name: self.state[name] for name in VARIABLES}

    def _planned_steps(self, phase: int) -> int:
        """Counts the steps of a phase; when each epoch draws new samples it may have one more or less."""
        return self.data.steps(phase) * (self.config.head_epochs, self.config.epochs)[phase - 1]

    def _optimizer(self, phase: int) -> optax.GradientTransformation:
        if phase not in self._optimizers:  # jit compiles once for each object, so keep it
            self._optimizers[phase] = self.config.make_optimizer(phase, self._planned_steps(phase))
        return self._optimizers[phase]

    def _train_epoch(self, until: float) -> None:
        """Trains from the present step to the end of the epoch, then validates and saves a checkpoint; when it is
        later than `until`, it saves one and ends.
        """
        here, data = self.position, self.data
        steps, count, done = data.steps(here.phase, here.epoch), data.count(here.phase, here.epoch), here.samples
        began = time.perf_counter()
        running: deque[tuple[jax.Array, float]] = deque()
        with self._bar(f"phase {here.phase}, epoch {here.epoch + 1}", count, initial=int(done)) as bar:
            for batch in self._batches():
                running.append((self._step(batch), float(batch.weight.sum())))
                here.step, here.total = here.step + 1, here.total + 1
                stops = time.monotonic() >= until and here.step < steps
                saves = stops or here.step % self.config.checkpoint_steps == 0 and here.step < steps
                while len(running) > (0 if saves or here.step == steps else IN_FLIGHT):
                    self._count(*running.popleft(), here.step - len(running), bar)
                if not running and not is_finite(self.state):
                    raise self._diverged("a parameter that is no number", here.step)
                if here.samples and here.step % max(steps // REPORTS, 1) == 0 and here.step < steps:
                    rate = (here.samples - done) / (time.perf_counter() - began)
                    self._report({"loss": here.loss / here.samples, "samples_per_s": rate})
                if saves:
                    self.checkpoints.save(here.total, self.state, self._meta(here.phase))
                if stops:
                    return
        self._finish_epoch((here.samples - done) / (time.perf_counter() - began))

    def _batches(self) -> Iterator[Batch]:
        """Yields the batches of this epoch from the present step on, features of a frozen trunk in place of samples."""
        here = self.position
        for batch in self.data.batches(here.phase, here.epoch, here.step):
            yield batch._replace(inputs=self.features["training"][batch.inputs]) if self.phase.frozen_trunk else batch

    def _step(self, batch: Batch) -> jax.Array:
        """Takes a step and returns its loss, which the devices may still be computing."""
        phase, devices = self.phase, self.devices
        frozen = phase.frozen_trunk
        inputs = devices.shard(batch.inputs) if frozen else phase.place(self.source, batch.inputs, devices)
        placed = Batch(inputs, *devices.shard((batch.targets, batch.weight)))
        settings = StepSettings(self.graph, phase, self._optimizer(self.position.phase), self.config.penalty)
        self.state, loss = update(self.state, placed, self.config.seed, self.position.total, settings=settings)
        return loss

    def _count(self, loss: jax.Array, samples: float, number: int, bar: progress.Bar) -> None:
        """Adds a batch to the epoch's sums."""
        here, value = self.position, float(loss)
        if not math.isfinite(value):
            raise self._diverged(f"loss = {value}", number)
        here.loss, here.samples = here.loss + value * samples, here.samples + samples
        bar.set_postfix(loss=f"{here.loss / here.samples:.3f}", refresh=False)
        bar.update(int(samples))

    def _diverged(self, what: str, number: int) -> InputError:
        where = f"batch {number} of phase {self.position.phase}, epoch {self.position.epoch + 1}"
        return InputError(
            f"{what} in {where}: training stopped; the last checkpoint is kept, try a lower learning_rate"
        )

    def _finish_epoch(self, rate: float) -> None:
        here = self.position
        row = {"loss": here.loss / here.samples, "samples_per_s": rate, **self._validated(), **self._eval_scores()}
        overall = row["average_precision"]["overall"] or 0.0
        best, here.best = overall > here.best, max(here.best, overall)
        self._report(row)
        self._say(_summary(here, row, best))
        here.epoch, here.step, here.loss, here.samples = here.epoch + 1, 0, 0.0, 0.0
        self.checkpoints.save(here.total, self.state, self._meta(here.phase) | {"validation": row}, best)

    def _validated(self) -> dict[str, Any]:
        """Returns loss, the best constant predictor's loss, average precision and F1 on the validation samples."""
        logits = self._logits("validation")
        failed = self.data.failed(self.data.validation)
        share = failed.mean(axis=0, dtype=np.float64)
        constant = sum(-(p * math.log(p) + (1 - p) * math.log(1 - p)) for p in share if 0 < p < 1)
        scores = metrics.evaluate(probabilities(logits), failed.astype(bool), events=self.run.robot.event_names)
        return {
            "validation_loss": float(optax.sigmoid_binary_cross_entropy(logits, failed).sum(axis=-1).mean()),
            "constant_loss": constant,
            "average_precision": metrics.json_ready(scores.average_precision),
            "f1": metrics.json_ready(scores.f1),
        }

    def _eval_scores(self) -> dict[str, Any]:
        """Returns confusion and average precision of each event, and overall, on the samples of `eval_sets`."""
        names = [name for name in self.scored if name != "validation"]
        failed = {name: self.data.failed(self.scored[name]).astype(bool) for name in names}
        events = self.run.robot.event_names
        score = lambda name: metrics.evaluate(probabilities(self._logits(name)), failed[name], events=events).scores
        scores = {name: score(name) for name in names}
        return {"eval_sets": metrics.json_ready(scores)} if names else {}

    def _logits(self, name: str) -> np.ndarray:
        """Returns the logits of the named samples in the present state: [k, events]."""
        if frozen := self.phase.frozen_trunk:
            features = self.devices.replicate(self.features[name])
            logits = self.devices.fetch(frozen.logits(self.graph, self._variables, features))
            if np.isfinite(logits).all():
                return logits
        else:
            with suppress(NoNumbers):
                return self._over(self.kind.logits, self.scored[name], name)
        raise self._diverged(f"a {name} logit that is no number", self.position.step)

    def summary(self) -> str:
        """Describes in one line the robot, the training data, the first weights and the devices."""
        run, device = self.run, jax.devices()[0].device_kind
        return (
            f"{run.robot.name}, {len(run.actions)} trajectories a map; {self.data.summary()}; first weights: "
            f"{run.preset.weights}; devices: {self.devices.mesh.size} x {device}"
        )

    def _over(self, function, samples: Samples, what: str) -> np.ndarray:
        placed = Placed(self.graph, self._variables, self.source, self.devices)
        with self._bar(what, len(samples[0])) as bar:
            return function(placed, samples, self.config.batch_size, bar.update)

    def _meta(self, optimizer: int) -> dict[str, Any]:
        """Returns the meta of a checkpoint; optimizer: the phase of the optimizer that it holds, 0 for none."""
        return {
            "position": asdict(self.position),
            "optimizer": optimizer,
            "dataset": self.data.dataset.fingerprint,
            "run": self.run.to_json(),
        }

    def _report(self, row: dict[str, Any]) -> None:
        here = self.position
        schedule = self.config.schedule_of(here.phase, self._planned_steps(here.phase))
        rate = float(schedule(here.epoch * self.data.steps(here.phase) + here.step - 1))  # the rate of the step before
        place = {"step": here.total, "phase": here.phase, "epoch": here.epoch + 1, "learning_rate": rate}
        if self.log:
            self.log.write(place | row)

    def _bar(self, what: str, total: int, unit: str = "sample", initial: int = 0) -> progress.Bar:
        return progress.bar(what, total, unit, self.quiet, initial=initial, leave=False)

    def _say(self, text: str) -> None:
        if not self.quiet:
            progress.say(text)


def _summary(here: Position, row: dict[str, Any], best: bool) -> str:
    shown = lambda value: "-" if value is None else f"{value:.3f}"
    precisions = {name: value for name, value in row["average_precision"].items() if name != "mean"}
    precision = ", ".join(f"{name} {shown(value)}" for name, value in precisions.items())
    losses = f"loss {row['loss']:.3f}, validation {row['validation_loss']:.3f} (constant {row['constant_loss']:.3f})"
    rate = f"{row['samples_per_s']:.0f} samples/s"
    star = ", best so far" if best else ""
    return f"phase {here.phase}, epoch {here.epoch + 1}: {losses}; average precision: {precision}; {rate}{star}"
