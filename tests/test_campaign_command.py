import jax
import numpy as np
import pytest
import xarray as xr

from benchmarks import tiny_campaign as tiny
from experiments import campaigns
from experiments.running import LOOPS
from jaxatt.campaign import dataset, workers
from jaxatt.campaign.draw import checked, drawn
from jaxatt.engine import validated


@pytest.fixture
def plan(monkeypatch):
    """A loop small enough for every test of the command."""
    draw = lambda u: dict(start=2 * u[0] - 1, push=np.sin(1) * u[1])
    scenario = lambda d: tiny.Scenario(d["start"], d["push"])
    plan = campaigns.Plan(tiny.system, tiny.Params(), tiny.score, 30, 2, draw, scenario, dict(start="m"), tiny.record)
    monkeypatch.setitem(campaigns.PLANS, "tiny", plan)


def test_the_command_runs_stops_on_interrupt_and_goes_on(plan, tmp_path, monkeypatch, capsys):
    words = ["--n", "1024", "--block", "128", "--out", str(tmp_path / "x")]
    write, blocks = workers.write_block, []

    def interrupted(*args):
        write(*args)
        blocks.append(args[1])
        if len(blocks) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(workers, "write_block", interrupted)
    assert campaigns.main("tiny", words) == 130
    monkeypatch.setattr(workers, "write_block", write)
    told = capsys.readouterr().err
    assert "every block written is kept. To go on: python -m experiments tiny campaign --n 1024" in told
    assert told.rstrip().endswith("--resume") and "scenarios/s" in told
    assert dataset(tmp_path / "x" / "campaign.zarr").sizes["scenario"] == 3 * 128
    with pytest.raises(SystemExit) as refused:
        campaigns.main("tiny", words)
    assert refused.value.code == 2 and "is there already: give --resume" in capsys.readouterr().err
    assert campaigns.main("tiny", [*words, "--seed", "1", "--resume"]) == 1
    assert "key is [0, 1], but [0, 0] in the store" in capsys.readouterr().err
    assert campaigns.main("tiny", [*words, "--resume"]) == 0
    assert "1024 scenarios done: 1024 good" in capsys.readouterr().out
    assert {f.name for f in (tmp_path / "x").iterdir()} == {
        "campaign.zarr", "campaign.zarr.lock", "summary.txt", "sensitivity.png"
    }  # fmt: skip
    for k in range(2):
        assert campaigns.main("tiny", [*words[:-1], str(tmp_path / "y"), "--shard", f"{k}/2"]) == 0
    stores = [tiny.files(tmp_path / out / "campaign.zarr") for out in "xy"]
    assert stores[0] == stores[1]
    assert campaigns.main("tiny", ["--n", "1100", *words[2:], "--resume"]) == 0  # grown
    assert dataset(tmp_path / "x" / "campaign.zarr").sizes["scenario"] == 1100


@pytest.mark.parametrize("words", [["--design", "sobol"], ["--design", "latin"], ["--every", "10"]])
def test_designs_and_records_from_the_command(plan, tmp_path, words):
    assert campaigns.main("tiny", ["--n", "128", "--block", "128", "--out", str(tmp_path), *words]) == 0
    ds = dataset(tmp_path / "campaign.zarr")
    assert len(np.unique(ds.start.values)) == 128 and ("position" in ds) == (words[0] == "--every")
    if words[-1] == "latin":
        assert sorted(np.floor((ds.start.values + 1) * 64)) == list(range(128))


def test_bad_words_are_refused(tmp_path, capsys):
    for name, words, message in (
        ("other", [], "`NAME` must be one of observer_pd"),
        ("observer_pd", ["--shard", "3/3"], "invalid shard_of value: '3/3'"),
    ):
        with pytest.raises(SystemExit) as refused:
            campaigns.main(name, words)
        assert refused.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("name", LOOPS)
def test_every_experiment_draws_scenarios_that_its_loop_accepts(name):
    this = checked(campaigns.campaign(name, 128))
    scenarios, inputs = drawn(this, 0, 128)
    validated(this.system, this.params, scenarios, 128)
    assert all(len(leaf) == 128 for leaf in jax.tree.leaves((scenarios, inputs)))
    assert set(this.units) <= set(inputs)
    for values in jax.tree.leaves(inputs):
        assert np.isfinite(values).all() and (np.ptp(values, axis=0) > 0).all()


def test_the_summary_of_microsat_compares_runs_with_and_without_reconfiguration():
    at = lambda unit, kind: (campaigns.UNITS.index(unit), kind)
    fault = np.repeat([at("none", 4), at("wheel", 5), at("gyro", campaigns.KINDS.index("dead"))], 20, axis=0)
    act = np.tile([0.0, 1.0], 30)
    degrees = np.where((fault[:, 0] == 2) & (act == 0), 90.0, 0.02)
    status = (np.arange(60) == 59).astype(np.int8)  # the last run failed: it is not kept
    columns = dict(unit=fault[:, 0], kind=fault[:, 1], act=act, last=np.deg2rad(degrees), status=status)
    made = xr.Dataset({k: ("scenario", v) for k, v in columns.items()}, {"scenario": np.arange(60)})
    told = [" ".join(line.split()) for line in campaigns.compared(made).splitlines()[-6:]]
    assert told[0] == "none act 10 0.0200 (0.0200 to 0.0200) 0 (0 to 0.3085)"
    assert [line.split(" 10 ")[0] for line in told[1:4]] == ["none not", "wheel seized act", "wheel seized not"]
    assert told[4] == "gyro dead act 10 0.0200 (0.0200 to 0.0200) 0.1 (0.002529 to 0.445)"
    assert told[5] == "gyro dead not 10 90.0000 (90.0000 to 90.0000) 1 (0.6915 to 1)"
