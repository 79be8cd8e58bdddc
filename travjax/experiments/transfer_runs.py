"""The transfer experiment: what pre-training is worth on real maps (SPEC section 11, the second half of the paper).

Runs that differ in their first weights alone, the arms, train on the same samples of real maps with the same settings,
and are scored after every epoch on held-out ground. With `head_epochs` the trunks stay frozen, and the features of each
are computed once for all seeds; with `epochs` everything is trained, as in the paper.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from flax import nnx

from travjax.config import InputError, require
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples, natural_sample
from travjax.devices import Devices
from travjax.estimators.preset import MOST, TrainingConfig, find_weights
from travjax.files import output_folder
from travjax.jax_flags import key_of
from travjax.models.trajectory_resnet import Estimator, Heads, create
from travjax.models.variables import Network
from travjax.resnet.imagenet_weights import load_weights
from travjax.runs.checkpoint import load_meta
from travjax.runs.run import Run, checked_meta, has_checkpoints, load_estimator
from travjax.runs.run_log import read_rows
from travjax.training.trainer import Trainer

ARMS = ("random", "ImageNet", "ImageNet + synthetic")
"""First weights of the runs, in the paper's order."""

SCRATCH, IMAGENET, SYNTHETIC = ARMS

FIELD_ARMS = (SCRATCH, "synthetic")
"""First weights where no phase freezes the trunk, as for the hazard field, which has no ImageNet weights."""


@dataclass(frozen=True)
class TransferConfig:
    """Describes the experiment; robot, network and inputs are those of the synthetic model.

    sites:      TOML file of the real maps, as `travjax dataset --sites` reads it
    synthetic:  preset that trains the synthetic model
    seeds:      seed of each run of an arm, for the order of samples, dropout and random first weights
    shown:      held-out site in the figure of maps; its licence must allow that
    shown_maps: number of its windows there
    training:   `head_epochs` for frozen trunks or `epochs` for all of it, not both
    trajectories_per_map: number of random known trajectories of each held-out window that are scored, 0 for all

    File names are relative to the folder of the preset. Raises InputError that names field, value and what is allowed.
    """

    sites: str = "../sites/real.toml"
    synthetic: str = "../resnet50/laptop.toml"
    seeds: tuple[int, ...] = (0, 1, 2)
    trajectories_per_map: int = field(default=200, metadata={"formerly": "each"})
    shown: str = "mars_live_site"
    shown_maps: int = 2
    training: TrainingConfig = TrainingConfig()

    def __post_init__(self):
        for name in ("sites", "synthetic", "shown"):
            require(isinstance(getattr(self, name), str), name, getattr(self, name), "a text")
        for name in ("trajectories_per_map", "shown_maps"):
            value = getattr(self, name)
            require(type(value) is int and 0 <= value <= MOST, name, value, f"a whole number from 0 to {MOST}")
        whole = isinstance(self.seeds, tuple) and bool(self.seeds)
        whole = whole and all(type(seed) is int and 0 <= seed < 2**31 for seed in self.seeds)
        allowed = "different whole numbers from 0, at least one"
        require(whole and len(set(self.seeds)) == len(self.seeds), "seeds", self.seeds, allowed)
        both = self.training.head_epochs and self.training.epochs
        require(not both, "[training] head_epochs", self.training.head_epochs, "0 where epochs is not, or the reverse")

    @property
    def frozen(self) -> bool:
        """Whether the trunks stay frozen."""
        return self.training.head_epochs > 0

    @property
    def epochs(self) -> int:
        """The number of epochs of each run."""
        return self.training.head_epochs or self.training.epochs


class Transfer:
    """Trains the runs of all arms, in a folder.

    base:      the synthetic model's run; synthetic: its folder, which is read when its arm begins
    held_out:  samples of the test maps of each site, at natural frequency
    Raises InputError when the data set is not for the run's robot, action space and grid, when it has no held-out site
    or not the one to be shown, and when the ImageNet weights are missing.
    """

    def __init__(
        self, config: TransferConfig, base: Run, synthetic: Path, dataset: Dataset, folder: Path, devices: Devices
    ):
        self.config, self.base, self.synthetic, self.dataset = config, base, synthetic, dataset
        self.folder, self.devices = folder, devices
        dataset.setup.require_same(base.setup, "data set")
        self.held_out = _held_out(dataset, config)
        if config.shown_maps:
            allowed = f"a held-out site, {', '.join(self.held_out)}, or shown_maps 0"
            require(config.shown in self.held_out, "shown", config.shown, allowed)
        find_weights(base.preset.weights)

    @property
    def arms(self) -> tuple[str, ...]:
        """The first weights of the runs; the synthetic model is the last."""
        return ARMS if 1 in self.base.kind.phases else FIELD_ARMS

    def run_of(self, arm: str, seed: int) -> Run:
        """Returns the run of an arm: the synthetic model's settings with the experiment's training settings."""
        preset = self.base.preset
        weights = {SCRATCH: "none", IMAGENET: preset.weights}.get(arm, f"{self.synthetic}")
        training = replace(self.config.training, seed=seed, subset_seed=self.config.training.sampling_seed)
        return replace(self.base, preset=replace(preset, weights=weights, training=training))

    def place_of(self, arm: str, seed: int) -> Path:
        """Returns the folder of a run, in the form that `travjax train` writes."""
        return self.folder / "runs" / f"{_name(arm)}_{seed}"

    def rows(self, arm: str, seed: int, until: float = math.inf) -> list[dict]:
        """Trains a run as far as it is not trained yet; returns a row for its first state and for each epoch.

        until: `time.monotonic()` after which no step begins; a run that has not ended by then has no rows
        """
        place, run = self.place_of(arm, seed), self.run_of(arm, seed)
        if has_checkpoints(place):
            self._require_same(place, run)
        if not self._is_finished(place, run) and not self._train(arm, seed, place, until):
            return []
        path = place / "metrics.jsonl"
        rows = [row for row in read_rows(path) if "eval_sets" in row]
        found, last, sites = [row.get("epoch") for row in rows], self.config.epochs, list(self.held_out)
        scored = all(isinstance(row["eval_sets"], dict) and list(row["eval_sets"]) == sites for row in rows)
        anew = f"0 to {last}, each with scores of {', '.join(sites)}; remove the folder to train it anew"
        require(found == list(range(last + 1)) and scored, f"{path}: epochs", found, anew)
        return rows

    def estimator(self, arm: str, seed: int) -> Network:
        """Loads the estimator of the epoch that is best on the validation windows."""
        return load_estimator(self.place_of(arm, seed), "best")[1]

    @cached_property
    def pretrained(self) -> Network:
        """The synthetic model, untouched."""
        return load_estimator(self.synthetic, "best")[1]

    def _require_same(self, place: Path, run: Run) -> None:
        """Raises InputError where a run that was begun would go on with other settings."""
        begun = Run.load(place)
        begun.require_same_settings(run, f"{place}")
        first = begun.preset.weights
        require(first == run.preset.weights, f"{place}: weights", run.preset.weights, f"{first}, as in the run so far")

    def _is_finished(self, place: Path, run: Run) -> bool:
        try:
            meta = load_meta(place / "checkpoints")
        except InputError:
            return False
        checked_meta(meta, place, run)
        begun, given = meta["dataset"], self.dataset.fingerprint
        require(begun == given, f"{place}: data set", given, f"{begun}, the one that the run was trained on")
        return meta["position"]["epoch"] == self.config.epochs

    def _train(self, arm: str, seed: int, place: Path, until: float) -> bool:
        run = self.run_of(arm, seed)
        features = output_folder(self.folder / "features") / f"{_name(arm)}.npz" if self.config.frozen else None
        trainer = Trainer(
            run, self.dataset, output_folder(place), self.devices, eval_sets=self.held_out, features=features
        )
        if self.devices.main:
            run.save(place)
        if has_checkpoints(place):
            trainer.resume()
        else:
            trainer.start(self._first(arm, seed))
        return trainer.train(until)

    def _first(self, arm: str, seed: int) -> Network:
        """Makes the network that a run begins with; random trunks differ by seed unless they stay frozen."""
        preset = self.base.preset
        if arm == self.arms[-1]:
            return self.pretrained
        if 1 not in self.base.kind.phases:
            return self.base.create(seed)
        file = find_weights(preset.weights) if arm == IMAGENET else None
        weights = load_weights(file, preset.trunk) if file else None
        trunk_seed = self.config.seeds[0] if self.config.frozen else seed
        made, events = create(preset.trunk, preset.heads, trunk_seed, weights), self.base.robot.event_names
        rngs = nnx.Rngs(key_of(seed + 1))
        return Estimator(made.trunk, Heads(preset.trunk.features, preset.heads, events, rngs=rngs))


def _name(arm: str) -> str:
    return arm.lower().replace(" + ", "_")


def _held_out(dataset: Dataset, config: TransferConfig) -> dict[str, Samples]:
    """Returns samples of the test maps of each site; the trainer has others called training and validation."""
    test = dataset.maps_of("test")
    require(len(test) > 0, "held-out windows", 0, "at least one: a test site or a test strip")
    sites = list(dict.fromkeys(dataset.group[test].tolist()))
    each, seed = config.trajectories_per_map or len(dataset.actions), config.training.sampling_seed
    of = lambda site: natural_sample(dataset.labels, test[dataset.group[test] == site], seed, len(test), each)
    held_out = {site: of(site) for site in sites}
    for site, samples in held_out.items():
        require(site not in ("training", "validation"), "held-out site", site, "of another name")
        require(len(samples[0]) > 0, f"held-out site {site}: known trajectories", 0, "at least one")
    return held_out


def run_all(
    transfer: Transfer, on_run: Callable[[str, int], object], until: float = math.inf
) -> dict[str, dict[int, list[dict]]]:
    """Returns the rows of all runs by arm and seed, trained one after the other, all arms of a seed before the next.

    on_run: is called with each one as it begins
    until:  as `Transfer.rows` takes it; the seeds that all arms have ended by then are returned
    """
    results: dict[str, dict[int, list[dict]]] = {arm: {} for arm in transfer.arms}
    for seed in transfer.config.seeds:
        rows = {}
        for arm in transfer.arms:
            on_run(arm, seed)
            rows[arm] = transfer.rows(arm, seed, until)
            if not rows[arm]:
                return results
        for arm in transfer.arms:
            results[arm][seed] = rows[arm]
    return results
