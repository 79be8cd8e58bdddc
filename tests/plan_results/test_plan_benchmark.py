"""`travjax bench --plan`: a row for each size and contact model."""

import csv

from travjax.plan_results import plan_benchmark
from travjax.simulation.contact import CONTACTS


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
