"""On-board code in a file: it runs without jaxatt and gives the bits of `decide`."""

import json
import os
import subprocess
import sys
import zipfile
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import pytest

from jaxatt import Reading, check, exporting, fields, onboard
from jaxatt.loops import observer_pd as loop
from jaxatt.observers import AttitudeRate
from jaxatt.stepping import on_board
from jaxatt.vec import Vec3

TICKS = 12
COMPUTER = loop.computer_of(*loop.init(loop.params, loop.scenario))
ALONE = """
import sys
sys.modules["jaxatt"] = None
sys.path.insert(0, sys.argv[1])
import jax, numpy as np
from onboard import load
try:
    load(sys.argv[1])
except ValueError as error:
    print(error)
jax.config.update("jax_enable_x64", True)
code = load(sys.argv[1])
computer, told, said = code.computer, dict(np.load(sys.argv[2])), []
for k in range(len(told["q.valid"])):
    computer, log = code.decide(k, code.params, computer, {name: a[k] for name, a in told.items()})
    said.append({**computer, **log})
assert not any(name.startswith("jaxatt.") for name in sys.modules)
np.savez(sys.argv[3], **{name: np.stack([one[name] for one in said]) for name in said[0]})
"""


def readings() -> AttitudeRate:
    """Of all ticks; the third has no attitude."""
    rng = np.random.default_rng(3)
    q, w = (Reading(Vec3(*0.3 * rng.normal(size=(3, TICKS))), np.arange(TICKS) != lost) for lost in (2, 99))
    return AttitudeRate(q, w)


def test_a_file_gives_the_bits_of_decide_where_there_is_no_jaxatt(tmp_path):
    told = readings()
    at = lambda k: jax.tree.map(lambda a: a[k], told)
    flown: dict[str, Any] = dict(dt=loop.DT, flow=loop.computer_flow, substeps=loop.system.substeps)
    path = exporting.write(tmp_path / "computer.zip", loop.decide, loop.params, COMPUTER, at(0), **flown)
    np.savez(tmp_path / "told.npz", **fields.named(told, "readings"))
    run = [sys.executable, "-c", ALONE, str(path), str(tmp_path / "told.npz"), str(tmp_path / "said.npz")]
    quiet = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "JAX_ENABLE_X64")}
    done = subprocess.run(run, cwd=tmp_path, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "`path` must hold float32, but it is float64" in done.stdout
    said = np.load(tmp_path / "said.npz")

    step = jax.jit(lambda params, k, c, y: on_board(loop.decide, loop.computer_flow, loop.DT, 4, params, k, c, y))
    params, (computer, _) = check.converted(loop.params, (COMPUTER, at(0)))
    for k in range(TICKS):
        computer, _, (xi, alarm) = step(params, np.int64(k), computer, at(k))
        for name, a in (fields.named(computer, "") | {"0": xi, "1": alarm}).items():
            np.testing.assert_array_equal(said[name][k], a, err_msg=name)


class Low(NamedTuple):
    level: Annotated[Any, "V"]


class Known(NamedTuple):
    level: Annotated[Any, "V"] = 0.0
    gain: Annotated[Any, "1"] = 0.5


def follow(params, now, computer, y):
    level = computer.level + params * (y.level - computer.level)
    return computer._replace(level=level), {"error": y.level - level, "late": now.t > 0.15}


def test_what_the_file_says_of_its_numbers(tmp_path):
    path = exporting.write(
        tmp_path / "a.zip", follow, np.float32(0.25), Known(), Low(np.zeros(2, np.float32)[0]), dt=0.1
    )
    with zipfile.ZipFile(path) as file:
        about = json.loads(file.read("about.json"))
        assert len([line for line in file.read("onboard.py").decode().splitlines() if line.strip()]) <= 40
    assert about["dt"] == 0.1 and about["float"] == "float32" and about["platforms"] == ["cpu"]
    assert about["readings"] == {"level": {"unit": "V", "shape": [], "type": "float32"}}
    assert about["computer"]["gain"]["unit"] == "1" and about["log"]["late"]["type"] == "bool"
    code = onboard.load(path)
    computer, log = code.decide(2, {"params": 0.5}, code.computer, {"level": 1.0})
    assert (float(computer["level"]), float(log["error"]), bool(log["late"])) == (0.5, 0.5, True)
    with pytest.raises(ValueError, match=r"`readings` must hold the names of .* not so for \['level', 'volts'\]"):
        code.decide(0, code.params, code.computer, {"volts": 1.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(dt=0.0), "`dt` must be a positive number"),
        (dict(platforms=("abacus",)), "`platforms` must be some of cpu, cuda, rocm, tpu"),
        (dict(computer={"a.b": 0.0, "a": {"b": 0.0}}), "`computer` must name every number once"),
        (dict(decide=lambda *a: 1.0), "`decide` must return computer, log"),
        (dict(readings=Low("high")), r"`readings.level` must be a number"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message, tmp_path):
    given = dict(decide=follow, params=0.25, computer=Known(), readings=Low(0.0), dt=0.1) | change
    with pytest.raises((ValueError, TypeError), match=message) as refusal:
        exporting.write(tmp_path / "a.zip", **given)
    assert "\n" not in str(refusal.value) and not (tmp_path / "a.zip").exists()
