import json

import matplotlib.pyplot as plt
import numpy as np

from experiments.report import Report, written


def test_checks_figures_and_metrics(tmp_path, capsys):
    report = Report(tmp_path, True, "toy")
    assert report.check("equal", [1, 2], np.array([1.0, 2.05]), 0.1, "here")
    assert not report.check("unequal", 1, 1.2, 0.1, "here")
    assert not report.check("nan", 1, np.nan, 0.1, "here")
    assert report.relative("relative", 100, 102, 0.03, "here")
    assert report.within("bound", None, 5, [1, np.float32(5)], "here") and not report.within(
        "nan", 0, 1, np.nan, "here"
    )
    report.figure("line", plt.figure())
    assert not written(tmp_path, [report.found()])
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert [c["ok"] for c in metrics["checks"]] == [True, False, False, True, True, False]
    assert set(metrics["checks"][0]) == {"name", "expected", "measured", "tolerance", "source", "ok"}
    assert metrics["figures"] == ["toy/line.png"] and (tmp_path / "toy" / "line.png").exists()
    assert "jax" in metrics["versions"]
    assert "NOT OK" in capsys.readouterr().out
