"""Notebooks are stored without output, run, and say what their words promise."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest

import jaxatt
from jaxatt.replay import load

ROOT = Path(__file__).parents[1]
NOTEBOOKS = {path.stem: nbformat.read(path, as_version=4) for path in (ROOT / "notebooks").glob("*.ipynb")}
_spec = importlib.util.spec_from_file_location("telemetry", ROOT / "notebooks" / "telemetry.py")
assert _spec is not None and _spec.loader is not None
telemetry = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(telemetry)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_is_stored_without_output_and_begins_with_a_title(name):
    cells = NOTEBOOKS[name].cells
    assert cells[0].cell_type == "markdown" and cells[0].source.startswith("# ")
    for cell in cells:
        assert cell.cell_type != "code" or (not cell.outputs and cell.execution_count is None)


def executed(name, monkeypatch) -> dict:
    """The names that a notebook leaves, in its quick form; run here, for a kernel costs more than most of its cells."""
    monkeypatch.setenv("JAXATT_QUICK", "1")
    monkeypatch.setattr(jaxatt, "configure", lambda: None)  # too late in this process
    names: dict = {}
    for i, cell in enumerate(c for c in NOTEBOOKS[name].cells if c.cell_type == "code"):
        exec(compile(cell.source, f"{name}, cell {i}", "exec"), names)
    for number in plt.get_fignums():
        plt.figure(number).draw_without_rendering()
    assert plt.get_fignums()
    plt.close("all")
    return names


def test_first_steps(monkeypatch):
    names = executed("first_steps", monkeypatch)
    assert names["log"].alarm[300:].all() and not names["log"].alarm[100:300].any()
    below, above = names["size"] < 0.009, names["size"] > 0.06
    assert (names["swept"].miss[below] > 0.98).all() and (names["swept"].miss[above] < 0.01).all()


@pytest.mark.short
def test_sweep(monkeypatch):
    names = executed("sweep", monkeypatch)
    size, tau, seen = names["size"], names["tau"], names["seen"]
    assert not names["lucky"].any()
    assert seen[(size > 0.05) & (tau < 1)].all() and not seen[size < 0.008].any()
    assert names["swept"]["ok"].all() and not seen[names["index"]]


@pytest.mark.short
def test_tuning(monkeypatch):
    names = executed("tuning", monkeypatch)
    assert names["history"].cost.min() < names["history"].cost[0]
    assert names["after"]["error"].mean() < names["before"]["error"].mean()


def test_own_spacecraft(monkeypatch):
    names = executed("own_spacecraft", monkeypatch)
    (loop,) = (cell.source for cell in NOTEBOOKS["own_spacecraft"].cells if "system = System(" in cell.source)
    assert sum(bool(line.strip()) for line in loop.splitlines()) <= 60 and "lane" not in loop
    early, strong = names["onset"] < 8, names["strength"] < 0.5
    assert names["seen"][early & strong].all()
    assert (
        np.isfinite(names["swept"]["early"]).mean() < 0.05 and names["swept"]["error"].max() < 0.05 * 1.2
    )  # rad, of the slew


@pytest.mark.short
def test_singular_surfaces(monkeypatch):
    names = executed("singular_surfaces", monkeypatch)
    assert names["found"].condition[0] == pytest.approx(14.04, abs=0.01)
    assert names["found"].condition[0] < names["start"]


@pytest.mark.short
def test_recorded_data_finds_the_hidden_fault(monkeypatch):
    names = executed("recorded_data", monkeypatch)
    who, onset, size = telemetry.truth()
    dropped = names["dropped"].any(axis=0)
    assert dropped.tolist() == [i == who for i in range(4)]
    found = names["t"][np.argmax(names["dropped"][:, who])]
    assert 0 <= found - onset < 1.0
    assert names["jump"] == pytest.approx(size, rel=0.05)


@pytest.mark.short
def test_the_recorded_data_are_what_the_simulator_gives():
    columns = telemetry.recorded()
    units = {name.split(" [")[0]: name.split("[")[1][:-1] for name in columns}
    del units["time"]
    t, stored = load(telemetry.EXAMPLE, units)
    np.testing.assert_allclose(t, columns.pop("time [s]"), atol=5.1e-4)
    for (name, column), kept in zip(columns.items(), stored.values()):
        np.testing.assert_allclose(kept, column, rtol=1e-6, atol=1e-9, err_msg=name)
    who, *_ = telemetry.truth()
    assert not any(word in telemetry.EXAMPLE.read_text().splitlines()[0] for word in ("fault", "truth", "alarm"))
    assert 0 <= who < 4


def test_the_command_runs_a_notebook_in_a_kernel_and_reports_failures(tmp_path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("import jaxatt; print(jaxatt.__version__)")])
    broken = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    here = tmp_path / "notebooks"
    here.mkdir()
    (here / "__main__.py").write_text((ROOT / "notebooks" / "__main__.py").read_text())
    nbformat.write(notebook, here / "good.ipynb")
    nbformat.write(broken, here / "bad.ipynb")
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "notebooks", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 1 and "ZeroDivisionError" in done.stdout
    assert jaxatt.__version__ in nbformat.read(tmp_path / "out" / "good.ipynb", 4).cells[0].outputs[0].text
    unknown = subprocess.run([*command, "none"], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert unknown.returncode == 2 and "`NAME` must be one of bad, good, but it is none" in unknown.stderr


def test_rare_events(monkeypatch):
    names = executed("rare_events", monkeypatch)
    loss, limit = names["loss"], names["limit"]
    assert 1e-7 < loss.p < 1e-5 and not loss.flags
    assert np.all(np.nanmax(names["rows"][:, 0], axis=1) > limit * (1 - 1e-5))
    assert len(names["kinds"].index) == 1
    angle_noise = np.nanmean(names["rows"][:, 1], axis=0)
    assert angle_noise[30:60].mean() < -0.5 and abs(angle_noise).max() < 2  # a long lean to one side, no large sample
    assert names["tuned"].high < loss.low


def test_yardstick(monkeypatch):
    names = executed("yardstick", monkeypatch)
    code = [cell.source for cell in NOTEBOOKS["yardstick"].cells if cell.cell_type == "code"]
    assert sum(bool(line.strip()) for part in code[:3] for line in part.splitlines()) <= 40 and "rank(" in code[2]
    ewma, other = (names["board"].row(name) for name in ("ewma", "chi2_10"))
    assert (ewma["rank"], other["rank"]) == (1, 2) and ewma["macro"] < 5 and ewma["notes"] == []
    success = names["ranked"].row("observer")["success"]
    assert success["bias"] == success["none"] == 1 and success["sign"] < 0.1
