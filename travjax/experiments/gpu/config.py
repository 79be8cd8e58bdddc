"""What runs on the GPU: a preset names those of its parts, and says how the time is shared."""

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from travjax.config import load_toml, require, require_number, to_json
from travjax.estimators.names import FIELD, RESNET
from travjax.estimators.preset import MOST
from travjax.files import user_path
from travjax.runs.run import Run
from travjax.training.fit import run_from_preset

BENCH, TRANSFER = "bench", "transfer"

PARTS = (BENCH, FIELD, RESNET, TRANSFER)
"""The parts in order of worth."""


@dataclass(frozen=True)
class GpuConfig:
    """Describes the parts.

    field, resnet50: presets of `travjax train`; transfer: preset of the transfer experiment
    actions, size, spacing: as `Setup.load` takes them; "" is the paper's action space
    shares:       of the time that is left when a part begins, for each of PARTS
    evaluating:   share of a part's time that is kept for its evaluation
    field_epochs: epochs of the field, so that its learning rate falls to zero in time; 0: as its preset says
    test_maps:    test maps that the ResNet50 is evaluated on, 0 for all
    maps:         maps that are labelled at once in the benchmark; batches: samples in a training step there
    repeats:      timed calls, of which the median is taken

    File names are relative to the folder of the preset. Raises InputError that names field, value and what is allowed.
    """

    field: str
    resnet50: str
    transfer: str
    actions: str = ""
    size: float = 8.0
    spacing: float = 0.0625
    shares: tuple[float, ...] = (0.2, 0.5, 0.7, 1.0)
    evaluating: float = 0.2
    field_epochs: int = 0
    test_maps: int = 0
    maps: tuple[int, ...] = (32, 128, 512)
    batches: tuple[int, ...] = (64, 256)
    repeats: int = 10

    def __post_init__(self):
        for name in ("field", "resnet50", "transfer", "actions"):
            require(isinstance(getattr(self, name), str), name, getattr(self, name), "a text")
        count = isinstance(self.shares, tuple) and len(self.shares) == len(PARTS)
        require(count, "shares", self.shares, f"{len(PARTS)} numbers, for {', '.join(PARTS)}")
        for share in self.shares:
            require_number("shares", share, 0, math.nextafter(1, 2), "above 0 and at most 1")
        require_number("evaluating", self.evaluating, -1e-300, math.nextafter(1, 0), "from 0, below 1")
        for name in ("field_epochs", "test_maps"):
            value = getattr(self, name)
            require(type(value) is int and 0 <= value <= MOST, name, value, f"a whole number from 0 to {MOST}")
        for name in ("maps", "batches"):
            values = getattr(self, name)
            several = isinstance(values, tuple) and values and all(type(one) is int and one > 0 for one in values)
            require(bool(several), name, values, "one or more whole numbers from 1")
        require(type(self.repeats) is int and self.repeats > 0, "repeats", self.repeats, "a whole number from 1")


@dataclass(frozen=True)
class Plan:
    """A preset with the files that it names.

    path: the preset's file; weights: first weights of the ResNet50, None for those of its preset
    """

    path: Path
    config: GpuConfig
    weights: str | None

    @staticmethod
    def load(path: Path, weights: str | None) -> "Plan":
        """Reads a preset; raises InputError when it is missing or wrong."""
        return Plan(path, load_toml(path, GpuConfig), weights)

    def file(self, name: str) -> Path:
        """Returns the path of a file that the preset names."""
        return self.path.parent / user_path(name)

    @cached_property
    def runs(self) -> dict[str, Run]:
        """The training runs of the field and of the ResNet50; raises InputError when a preset is missing or wrong."""
        config = self.config
        actions = self.file(config.actions) if config.actions else None
        run_of = partial(run_from_preset, actions=actions, size=config.size, spacing=config.spacing)
        field = run_of(self.file(config.field), model=FIELD)
        if config.field_epochs:
            training = replace(field.preset.training, epochs=config.field_epochs)
            field = replace(field, preset=replace(field.preset, training=training))
        return {FIELD: field, RESNET: run_of(self.file(config.resnet50), model=RESNET, weights=self.weights)}

    def to_json(self) -> dict[str, Any]:
        """Converts what results depend on to what JSON can hold: the preset and its runs but for first weights."""
        runs = {name: replace(run, preset=replace(run.preset, weights="none")) for name, run in self.runs.items()}
        return {"config": to_json(self.config)} | {name: run.to_json() for name, run in runs.items()}
