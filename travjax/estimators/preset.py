"""Everything that a training run is made from, as one TOML file (presets/resnet50, presets/field)."""

from dataclasses import dataclass, field
from pathlib import Path

import optax

from travjax.config import InputError, load_toml, require, require_length, require_number
from travjax.data.dataset import DatasetConfig
from travjax.data.sensor_noise import CorruptionConfig
from travjax.estimators.names import ESTIMATORS, RESNET
from travjax.files import find_data, find_preset
from travjax.models.hazard_field import FieldConfig
from travjax.models.trajectory_resnet import HeadsConfig
from travjax.resnet.fetched_weights import fetched_weights
from travjax.resnet.network import ResNetConfig

SCHEDULES = ("constant", "cosine")

OPTIMIZERS = ("rmsprop", "adamw")

IMAGENET_WEIGHTS = "imagenet/resnet50_imagenet.npz"
"""The default ImageNet weights: where this file does not exist, others are fetched."""

MOST = 2**31 - 1
"""Largest value of any count, and of a seed."""


def _require_counts(config: object, *names: str, least: int) -> None:
    for name in names:
        value = getattr(config, name)
        require(type(value) is int and value >= least, name, value, f"a whole number, at least {least}")
        require(value <= MOST, name, value, f"at most {MOST}")


@dataclass(frozen=True)
class TrainingConfig:
    """How the network is trained (SPEC section 9).

    A sample is a map and a trajectory; for the hazard field it is a map.

    seed:                 seed of the subsets, their order, the heads' first values and dropout
    batch_size:           samples in a step
    head_epochs:          phase 1: epochs of the heads on the features of the frozen trunk
    epochs:               phase 2: epochs of everything
    optimizer:            "rmsprop", or "adamw" with its usual settings
    learning_rate:        largest learning rate
    decay, epsilon:       of RMSprop
    max_grad_norm:        gradients longer than this are cut to it; 0 leaves them as they are
    schedule:             of phase 2: "constant", or "cosine" down to zero
    warmup_steps:         steps of phase 2 over which the learning rate rises from zero
    weight_decay:         factor of the sum of squares of the heads' kernels in the loss; with "adamw" its own decay
    trajectories_per_map: in an epoch; for the hazard field in a step, whole first arcs, as frequent as they are
    failing_per_map:      how many of these fail if as many do
    resample_each_epoch:  a new subset of trajectories each epoch instead of the same one (phase 2)
    subset_seed:          seed of the subsets alone, so that runs of other seeds train on the same samples; else `seed`
    validation_samples:   at most this many of the validation maps' balanced subset
    checkpoint_steps:     steps from one checkpoint to the next; there is one after each epoch as well

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    seed: int = 0
    batch_size: int = 64
    head_epochs: int = 1
    epochs: int = 10
    optimizer: str = field(default="rmsprop", metadata={"formerly": "method"})
    learning_rate: float = 1e-4
    decay: float = 0.9
    epsilon: float = 1e-7
    max_grad_norm: float = field(default=0.0, metadata={"formerly": "clip"})
    schedule: str = "constant"
    warmup_steps: int = 0
    weight_decay: float = 0.001
    trajectories_per_map: int = field(default=11, metadata={"formerly": "each"})
    failing_per_map: int = field(default=6, metadata={"formerly": "failing"})
    resample_each_epoch: bool = field(default=False, metadata={"formerly": "fresh"})
    subset_seed: int | None = None
    validation_samples: int = 100_000
    checkpoint_steps: int = 500

    def __post_init__(self):
        _require_counts(self, "seed", "head_epochs", "epochs", "warmup_steps", "failing_per_map", least=0)
        _require_counts(self, "batch_size", "trajectories_per_map", "validation_samples", "checkpoint_steps", least=1)
        if self.subset_seed is not None:
            _require_counts(self, "subset_seed", least=0)
        most = f"at most trajectories_per_map = {self.trajectories_per_map}"
        require(self.failing_per_map <= self.trajectories_per_map, "failing_per_map", self.failing_per_map, most)
        require_number("learning_rate", self.learning_rate, 0, 10, "above 0 and at most 10")
        require_number("decay", self.decay, 0, 1, "above 0 and at most 1")
        require_number("epsilon", self.epsilon, 0, 1, "above 0 and at most 1")
        require_number("max_grad_norm", self.max_grad_norm, -1e-300, 1e6, "from 0 to 1000000")
        require(self.optimizer in OPTIMIZERS, "optimizer", self.optimizer, f"one of {', '.join(OPTIMIZERS)}")
        require_number("weight_decay", self.weight_decay, -1e-300, 10, "from 0 to 10")
        require(self.schedule in SCHEDULES, "schedule", self.schedule, f"one of {', '.join(SCHEDULES)}")
        require(
            type(self.resample_each_epoch) is bool, "resample_each_epoch", self.resample_each_epoch, "true or false"
        )
        require(self.head_epochs + self.epochs > 0, "epochs", self.epochs, "at least 1 where head_epochs is 0")

    @property
    def sampling_seed(self) -> int:
        """The seed of the subsets."""
        return self.seed if self.subset_seed is None else self.subset_seed

    def schedule_of(self, phase: int, steps: int) -> optax.Schedule:
        """Returns the learning rate of each of the `steps` of a phase; it varies in phase 2 only."""
        rate, warmup = self.learning_rate, self.warmup_steps
        if phase == 1 or self.schedule == "constant" and not warmup:
            return optax.constant_schedule(rate)
        if self.schedule == "constant":
            return optax.warmup_constant_schedule(0.0, rate, warmup)
        return optax.warmup_cosine_decay_schedule(0.0, rate, warmup, max(steps, warmup + 1))

    def make_optimizer(self, phase: int, steps: int) -> optax.GradientTransformation:
        """Makes the optimizer for the `steps` of a phase."""
        rate = self.schedule_of(phase, steps)
        if self.optimizer == "adamw":
            made = optax.adamw(rate, weight_decay=self.weight_decay)
        else:
            made = optax.rmsprop(rate, self.decay, self.epsilon, eps_in_sqrt=False)
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), made) if self.max_grad_norm else made

    @property
    def penalty(self) -> float:
        """The weight decay that is added to the loss."""
        return 0.0 if self.optimizer == "adamw" else self.weight_decay


@dataclass(frozen=True)
class EvaluationConfig:
    """The test samples that are evaluated, at natural frequency.

    maps: test maps; trajectories_per_map: random ones; 0 for all
    """

    maps: int = 0
    trajectories_per_map: int = field(default=0, metadata={"formerly": "each"})

    def __post_init__(self):
        _require_counts(self, "maps", "trajectories_per_map", least=0)


@dataclass(frozen=True)
class Preset:
    """The settings of a training run.

    model:           name of the estimator, one of ESTIMATORS
    robot:           name of a preset, or a .toml file
    weights:         file of the trunk's first weights, here or under TRAVJAX_DATA; "none" for random ones; where there
                     is no file of the name IMAGENET_WEIGHTS, others are fetched
    elevation_scale: metres that count as 1 in the elevation channel

    The rest are the tables of the file: trunk and heads belong to the ResNet; field and corruption, which alters the
    training maps, to the hazard field.

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    model: str = RESNET
    robot: str = "seekur_jr"
    weights: str = IMAGENET_WEIGHTS
    elevation_scale: float = 1.0
    dataset: DatasetConfig = DatasetConfig()
    trunk: ResNetConfig = ResNetConfig()
    heads: HeadsConfig = HeadsConfig()
    field: FieldConfig = FieldConfig()
    corruption: CorruptionConfig = CorruptionConfig()
    training: TrainingConfig = TrainingConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    def __post_init__(self):
        require(self.model in list(ESTIMATORS), "model", self.model, f"one of {', '.join(ESTIMATORS)}")
        if epochs := self.training.head_epochs:
            kind = ESTIMATORS[self.model].load()
            require(1 in kind.phases, "[training] head_epochs", epochs, f"0: {kind.title} has no frozen trunk")
        for name in ("robot", "weights"):
            value = getattr(self, name)
            require(isinstance(value, str) and bool(value), name, value, "a non-empty text")
        require_length("elevation_scale", self.elevation_scale, 0.001, 1000)

    @staticmethod
    def load(path: str | Path) -> "Preset":
        """Reads a preset from a TOML file; raises InputError when it is missing or wrong."""
        return load_toml(path, Preset)


def load_preset(given: str | Path, model: str | None = None) -> Preset:
    """Reads a preset that comes with travjax by its name, or a TOML file.

    model: the estimator whose preset the name is, the ResNet unless given; a file must be of it
    Raises InputError when there is none of that name, and when the file is missing, wrong or of another estimator.
    """
    names = list(ESTIMATORS)
    require(model is None or model in names, "model", model, f"one of {', '.join(names)}")
    path = find_preset(given, model or RESNET)
    preset = Preset.load(path)
    require(model in (None, preset.model), "model", model, f"{preset.model}, as {path} says")
    return preset


def find_weights(name: str) -> Path | None:
    """Returns the file of a preset's `weights`, None for "none".

    If IMAGENET_WEIGHTS is neither here nor under TRAVJAX_DATA, weights are taken from the cache or fetched.
    Raises InputError when the file does not exist, and for IMAGENET_WEIGHTS only when none can be fetched either.
    """
    if name == "none":
        return None
    try:
        return find_data(name, "weights", "--weights FILE, or none for random ones")
    except InputError:
        if name != IMAGENET_WEIGHTS:
            raise
    try:
        return fetched_weights()
    except InputError as error:
        raise InputError(
            f"weights {name}: neither here nor under TRAVJAX_DATA, and not to be fetched: {error}; allowed: "
            "--weights FILE (make train WEIGHTS=FILE) fetched elsewhere, as travjax weights --from FILE writes it, or "
            "TRAVJAX_DATA with this file; --weights none; --model field (make train MODEL=field) needs none"
        ) from None
