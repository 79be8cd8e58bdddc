"""Estimates what a GPU would take, from programs that are read and not run.

An estimate has two ends. At the limit (limits.py) all else is fused into products and gathers; unfused, every operation
reads its operands from memory and writes its result. What is not counted: launches, the host, reads that caches answer.
"""

from dataclasses import replace

from travjax.estimators.map_estimator import MAPS
from travjax.estimators.names import FIELD, RESNET
from travjax.evaluation.tables import rows_table
from travjax.experiments.gpu.config import Plan
from travjax.experiments.gpu.kernels import OPERATIONS, labelling_work
from travjax.experiments.gpu.limits import DEVICES, Device
from travjax.experiments.gpu.programs import Program, as_on_a_gpu, prediction, read_program, training_step
from travjax.runs.run import Run
from travjax.simulation.contact import CONTACTS, Contact

DEVICE = "NVIDIA H100 80GB HBM3"

COLUMNS = {
    "what": "what",
    "size": "at once",
    "operations": "10^9\noperations",
    "tf32": "of these\nin tf32",
    "products": "products",
    "gathers": "gathers",
    "megabytes": "MB at\nthe limit",
    "gathered": "MB\ngathered",
    "unfused": "MB\nunfused",
    "limit": "us each\nat the limit",
    "by": "limited by",
    "slowest": "us each\nunfused",
    "per_s": "per s\nat the limit",
    "per_s_unfused": "per s\nunfused",
}


def estimate(plan: Plan) -> str:
    """Returns a table of training steps, predictions and labelling of a preset on DEVICE, and what its training takes.

    Raises InputError when one of its presets is missing or wrong.
    """
    device = DEVICES[DEVICE]
    field, resnet = plan.runs[FIELD], plan.runs[RESNET]
    with as_on_a_gpu():
        programs = [
            (f"{name} {what}", size, read_program(lower(run, size)))
            for name, run, batch in ((FIELD, field, MAPS), (RESNET, resnet, resnet.preset.training.batch_size))
            for what, size, lower in (
                ("training", run.preset.training.batch_size, training_step),
                ("prediction", batch, prediction),
            )
        ]
    rows = [_row(what, size, program, device) for what, size, program in programs]
    trained = {what: row for (what, *_), row in zip(programs, rows, strict=True)}
    rows += [_labelling_row(resnet, contact, device) for contact in CONTACTS]
    costs = [_cost(name, plan.runs[name], trained[f"{name} training"]) for name in (FIELD, RESNET)]
    head = f"Estimates for {DEVICE}, preset {plan.path.stem}; nothing was measured on it."
    return "\n".join([head, rows_table(rows, COLUMNS), *costs])


def _row(what: str, size: int, program: Program, device: Device) -> dict:
    limit, by = program.work.limit(device)
    slowest = max(program.unfused / device.bandwidth, limit)
    return {
        "what": what,
        "size": size,
        "operations": sum(program.operations.values()) / 1e9,
        "tf32": program.operations["tf32"] / 1e9,
        "products": program.products,
        "gathers": program.gathers,
        "megabytes": program.work.bytes / 1e6,
        "gathered": program.gathers_bytes / 1e6,
        "unfused": program.unfused / 1e6,
        "limit": limit / size * 1e6,
        "by": by,
        "slowest": slowest / size * 1e6,
        "per_s": size / limit,
        "per_s_unfused": size / slowest,
    }


def _labelling_row(run: Run, contact: str, device: Device) -> dict:
    """Returns the row of labelling one map, whose reads of nodes are gathers that caches answer."""
    work, _ = labelling_work(replace(run.setup, contact=Contact.from_model(contact)))
    limit, by = work.limit(device)
    operations = sum(work.operations.values())
    return dict.fromkeys(COLUMNS) | {
        "what": f"labelling by {contact}",
        "size": 1,
        "operations": operations / 1e9,
        "megabytes": work.bytes / 1e6,
        "gathered": 4 * operations / OPERATIONS / 1e6,
        "limit": limit * 1e6,
        "by": by,
        "per_s": 1 / limit,
    }


def _cost(name: str, run: Run, row: dict) -> str:
    """Says what the epochs of a run take at both ends of the estimate; those of heads alone count as none."""
    data, training = run.preset.dataset, run.preset.training
    each = 1 if run.kind.reads_whole_maps else training.trajectories_per_map
    samples = data.split_sizes()[0] * each * training.epochs
    ends = " to ".join(f"{samples / row[key]:,.0f}" for key in ("per_s", "per_s_unfused"))
    return f"{name}: {samples:,} samples in {training.epochs} epochs take {ends} s"
