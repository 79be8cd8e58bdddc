"""The parts of the command: each goes on where it stopped, ends in time, and puts what is small into the folder."""

import importlib.util
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from travjax import progress
from travjax.config import InputError, read_json, read_text, require
from travjax.data.dataset import Dataset, DatasetConfig, generate
from travjax.devices import Devices
from travjax.estimators.names import RESNET
from travjax.evaluation.metrics import OVERALL, json_ready
from travjax.evaluation.simulator_benchmark import machine, write_tsv
from travjax.experiments import transfer
from travjax.experiments.gpu.config import BENCH, TRANSFER, Plan
from travjax.experiments.gpu.kernels import COLUMNS, Kernels
from travjax.experiments.launch import verbatim
from travjax.files import atomic_write, output_folder, save_text
from travjax.runs.checkpoint import load_meta
from travjax.runs.model_card import export_run
from travjax.runs.run import Run, has_checkpoints
from travjax.runs.run_log import read_rows
from travjax.simulation.setup import Setup
from travjax.training.evaluation_report import evaluate_run
from travjax.training.fit import fit

RESULTS = "summary.json"
"""Name of the file of what is known of each part."""

WORK = "work"
"""Name of the folder of checkpoints and all that is large."""

LARGEST_EXPORT = 20e6
"""Bytes of the largest estimator that is exported."""

Result = dict[str, Any]
"""What is known of a part, as JSON can hold it; "finished" tells whether nothing is left to do."""


@dataclass
class Session:
    """One call of the command.

    out:     the folder of results
    results: what is known of the parts, by name, as RESULTS holds it
    made:    the data sets that were made, in memory, by their configuration, and how many seconds that took
    """

    plan: Plan
    out: Path
    results: dict[str, Result] = field(default_factory=dict)
    made: dict[tuple[DatasetConfig, Setup], tuple[Dataset, float]] = field(default_factory=dict)

    @staticmethod
    def load(plan: Plan, out: Path) -> "Session":
        """Goes on in a folder; raises InputError where it holds results of another preset, or something else."""
        path, described = out / "config.json", plan.to_json()
        if not path.exists():
            save_text(path, json.dumps(described, indent=1) + "\n")
        elif read_json(path) != described:
            raise InputError(f"--out {out}: holds results of another preset; allowed: another folder, or that preset")
        results = read_json(out / RESULTS) if (out / RESULTS).exists() else {}
        whole = lambda result: isinstance(result, dict) and {"finished", "seconds"} <= result.keys()
        known = isinstance(results, dict) and all(map(whole, results.values()))
        require(known, f"{out / RESULTS}", results, "results by part; remove it to begin anew")
        return Session(plan, out, results)

    def note(self, name: str, result: Result) -> None:
        """Keeps what is known of a part from now on, also if the command is killed."""
        self.results[name] = {"seconds": 0.0} | result
        save_text(self.out / RESULTS, json.dumps(self.results, indent=1, allow_nan=False) + "\n")

    def is_finished(self, name: str) -> bool:
        """Tells whether nothing is left to do for a part, on this machine and from the ResNet50 as it is now."""
        result = self.results.get(name, {})
        if name == BENCH and {row.get("machine") for row in result.get("rows", [])} - {machine()}:
            return False
        if name == TRANSFER and _best_step(self.work / RESNET) not in (None, result.get("synthetic_steps")):
            return False
        return bool(result.get("finished"))

    @property
    def work(self) -> Path:
        """The folder of checkpoints and all that is large."""
        return self.out / WORK

    def dataset(self, run: Run) -> tuple[Dataset, float]:
        """Makes and labels the maps of a run, unless that is done; returns them and the seconds that it took."""
        config = run.preset.dataset
        if (config, run.setup) not in self.made:
            began = time.perf_counter()
            with progress.bar("making", config.maps, "map") as bar:
                made = generate(config, run.setup, bar.update)
            self.made[config, run.setup] = made, time.perf_counter() - began
        return self.made[config, run.setup]

    def bench(self, before: Result, until: float) -> Result:
        """Measures kernels and network; rows of earlier calls on the same machine are kept."""
        kernels = Kernels(self.plan.config, self.plan.runs[RESNET])
        result, count = before, len(kernels.measurements())
        for rows in kernels.rows(before.get("rows", []), until):
            result = before | {"finished": len(rows) == count, "rows": rows}
            with atomic_write(self.out / "bench.tsv") as temporary:
                write_tsv(rows, temporary, COLUMNS)
            self.note(BENCH, result)
        return result

    def train(self, name: str, before: Result, until: float) -> Result:
        """Trains an estimator until its evaluation has to begin, and evaluates the best of its checkpoints."""
        run, folder = self.plan.runs[name], self.work / name
        data, seconds = self.dataset(run)
        result = before | {"maps": len(data.split), "made_and_labelled_s": seconds}
        stop = until - self.plan.config.evaluating * (until - time.monotonic())
        finished = fit(run, folder, Devices.all(), data, resume=True, until=stop)
        if not has_checkpoints(folder):
            return result | {"finished": False}
        which = "latest" if _best_step(folder) is None else "best"
        maps = 0 if run.kind.reads_whole_maps else self.plan.config.test_maps
        scores = evaluate_run(
            folder, data, which, folder / "evaluation", maps=maps, each=0, figure_maps=0, baselines=False
        )
        at = load_meta(folder / "checkpoints")["position"]
        rates = [row["samples_per_s"] for row in read_rows(folder / "metrics.jsonl") if "samples_per_s" in row]
        result |= {
            "finished": finished,
            "phase": at["phase"],
            "epochs": at["epoch"],
            "steps": at["total"],
            "samples_per_s": rates[-1] if rates else None,
            "evaluated": which,
            "f1": json_ready(scores.f1)[OVERALL],
            "recall": json_ready(scores.scores[OVERALL].confusion.recall),
        }
        _copy(folder / "evaluation", self.out / name, ("tables.txt", "evaluation.json", "precision_recall.png"))
        _copy(folder, self.out / name, ("metrics.jsonl", "run.json"))
        return result | self._export(name, run, which)

    def _export(self, name: str, run: Run, which: str) -> Result:
        """Exports an estimator with its model card, unless it is too large."""
        size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(run.template(0)))
        if size > LARGEST_EXPORT:
            return {"exported": None}
        path, _ = export_run(self.work / name, self.out / f"{name}.safetensors", which)
        return {"exported": path.name}

    def transfer(self, before: Result, until: float) -> Result:
        """Trains on real maps, or on stand-ins where none can be read, from the ResNet50 as far as it is trained.

        All of it is from one state of the ResNet50: where that was trained further since, the transfer begins anew.
        """
        synthetic, folder = self.work / RESNET, output_folder(self.work / TRANSFER)
        steps = _best_step(synthetic)
        if steps is None:
            raise InputError(f"{synthetic}: no epoch is finished yet; needed: more --time for {RESNET}")
        if before.get("synthetic_steps", steps) != steps:
            progress.say(f"from {steps:,} steps of the ResNet50, not {before['synthetic_steps']:,}: begins anew")
            shutil.rmtree(folder / "runs", ignore_errors=True)
        self.note(TRANSFER, before | {"finished": False, "synthetic_steps": steps})
        stop = until - self.plan.config.evaluating * (until - time.monotonic())
        finished = transfer.experiment(
            self.plan.file(self.plan.config.transfer),
            folder,
            lambda preset: Run.load(synthetic),
            synthetic,
            stand_ins=importlib.util.find_spec("rasterio") is None,
            until=stop,
        )
        _copy(folder, self.out / TRANSFER, ("report.md", "results.json", "f1.png", "stand_in_sites.png", "maps.png"))
        return {"finished": finished, "synthetic_steps": steps}

    def part(self, name: str) -> Callable[[Result, float], Result]:
        """Returns the function of a part; it takes what is known of it, and `time.monotonic()` when it has to end."""
        named = {BENCH: self.bench, TRANSFER: self.transfer}
        return named.get(name) or (lambda before, until: self.train(name, before, until))


def _best_step(folder: Path) -> int | None:
    """Returns the step of a run's best checkpoint; None where it has not finished an epoch."""
    try:
        return load_meta(folder / "checkpoints", "best")["position"]["total"]
    except InputError:
        return None


def _copy(source: Path, target: Path, names: tuple[str, ...]) -> None:
    """Copies those of the named files that exist."""
    output_folder(target)
    for name in names:
        if (source / name).exists():
            with atomic_write(target / name) as temporary:
                shutil.copyfile(source / name, temporary)


def tables(out: Path, name: str) -> str | None:
    """Returns what a report says of an evaluation: its tables, or a link for the transfer; None where there is none."""
    path = out / name / ("report.md" if name == TRANSFER else "tables.txt")
    if name == BENCH or not path.exists():
        return None
    return f"[Report]({name}/{path.name})" if name == TRANSFER else verbatim(read_text(path).strip())
