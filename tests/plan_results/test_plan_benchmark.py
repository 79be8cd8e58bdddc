"""`travjax bench --plan`: a row for each size and contact model, and an end where a motion is refused."""

import csv

from tests.planning.sites import SPACING, plane
from travjax.plan_results import plan_benchmark
from travjax.planning import planner
from travjax.simulation.contact import CONTACTS
from travjax.site.ground import ArrayGround


def test_there_is_a_row_for_every_size_and_contact_model(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan_benchmark, "SIZES", (8.0, 10.0))
    monkeypatch.setattr(plan_benchmark, "TASKS", 1)
    monkeypatch.setattr(plan_benchmark, "CONTACTS", CONTACTS[:1])
    plan_benchmark.measure("seekur_jr", tmp_path)
    with (tmp_path / "plan.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert [(row["what"], float(row["size_m"])) for row in rows] == [("nearest", 8.0), ("nearest", 10.0)]
    for row in rows:
        assert float(row["length_m"]) > 0.8 * float(row["size_m"]) and 0 < float(row["searched"]) <= 1
        assert float(row["path_s"]) > 0 and float(row["check_s"]) > 0 and int(row["peak_mib"]) > 100
    assert float(rows[0]["to_go_s"]) > 0 and not rows[1]["to_go_s"]
    assert str(tmp_path / "plan.tsv") in capsys.readouterr().out


def test_a_motion_that_the_simulators_refuse_is_replaced(monkeypatch):
    drive, paths = planner.drive, []

    def refusing(*arguments):
        path, owner = drive(*arguments)
        path.exceeds[3] = not paths
        paths.append(path)
        return path, owner

    monkeypatch.setattr(planner, "drive", refusing)
    ground = ArrayGround(plane().astype("float32"), 0.0, SPACING)
    took = plan_benchmark._planned(ground, "seekur_jr", "nearest", 8.0, 0)
    assert len(paths) == 2 and took["length_m"] == paths[1].length
