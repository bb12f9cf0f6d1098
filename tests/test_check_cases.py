"""The check cases see the mistakes that one makes; their tools read what they should. CI runs the cases themselves beside the tests."""

import jax

jax.config.update("jax_enable_x64", True)

import csv  # noqa: E402
import re  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NamedTuple  # noqa: E402

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from benchmarks import check_plant as cc  # noqa: E402
from benchmarks.check_cases import nesc  # noqa: E402
from benchmarks.check_references import BRICK, CASES, EARTH_RATE, NAMES  # noqa: E402
from jaxatt import System  # noqa: E402
from jaxatt.attitude import quat_to_body  # noqa: E402
from jaxatt.bodies import gravity_gradient  # noqa: E402
from jaxatt.vec import cross, inverse, norm  # noqa: E402

ROOT = Path(__file__).parents[1]


class Wrong(NamedTuple):
    """Mistakes of the dynamics that no input can make: 1 where they are made."""

    sign: Any = 0.0  # of w x J w
    radius: Any = 0.0  # gravity gradient with the radius of the start


def flow(params, pair, t, x, z):
    """The flow of the cases with the difference that a mistake makes."""
    s, wrong = pair
    right = cc.flow(params, s, t, x, z, mrp=False)
    r, r0 = norm(x.r), norm(s.r)
    gravity = lambda size: gravity_gradient(quat_to_body(x.q, x.r / -r), s.J, jnp.sqrt(s.mu / size**3))
    off = 2 * wrong.sign * cross(x.w, s.J @ x.w) + wrong.radius * s.gradient * (gravity(r0) - gravity(r))
    return right._replace(w=right.w + inverse(s.J) @ off)


def of_pair(f, params, pair, *rest):
    return partial(f, mrp=False)(params, pair[0], *rest)


SYSTEM = System(partial(of_pair, cc.init), partial(of_pair, cc.tick), flow, dt=1.0)


def swapped(case, i, j):
    """The case with the sign of a product of inertia changed."""
    J = np.array(case.J)
    J[i, j] = J[j, i] = -J[i, j]
    return case._replace(J=J)


MUTANTS = {  # case, the input that is wrong, what is wrong in the dynamics; attitude error at the end [deg], of NumPy
    "sign of w x J w": ("9B", None, Wrong(sign=1.0), 52),
    "radius of the start, circular": ("10A", None, Wrong(radius=1.0), 0.3),
    "radius of the start, elliptical": ("10D", None, Wrong(radius=1.0), 2.5),
    "3-2-1 order": ("10A", lambda c: c._replace(turns=c.turns[::-1]), Wrong(), 28),
    "sign of Jxy": ("9B", lambda c: swapped(c, 0, 1), Wrong(), 94),
    "sign of Jyz": ("9A", lambda c: swapped(c, 1, 2), Wrong(), 0.19),
    "rate of LVLH dropped": ("10A", lambda c: c._replace(relative=False), Wrong(), 35),
    "no gravity gradient": ("10D", lambda c: c._replace(gradient=0.0), Wrong(), 48),
    "impulse 0.1 % too large": ("9B", lambda c: c._replace(torque=(10.01, 0.0, 0.0)), Wrong(), 6e-3),
}


@pytest.fixture(scope="module")
def found():
    """Logs of the cases and then of the mutants, side by side in one program."""
    pairs = [(cc.scenario_of(case), Wrong()) for case in CASES]
    for name, change, wrong, _ in MUTANTS.values():
        case = CASES[NAMES.index(name)]
        pairs.append((cc.scenario_of(change(case) if change else case), wrong))
    return cc.logs(SYSTEM, cc.stacked(pairs), 28800, 60)


def against(found, case, i):
    return cc.against(case, {name: a[i] for name, a in found.items()}, lambda t: round(t / 60))


def test_the_right_plant_keeps_every_reference(found):
    for i, case in enumerate(CASES):
        assert cc.within(against(found, case, i), cc.LIMITS), case.name


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_mistake_is_seen_by_as_much_as_it_should_be(found, mutant):
    name, _, _, error = MUTANTS[mutant]
    case = CASES[NAMES.index(name)]
    i = len(CASES) + list(MUTANTS).index(mutant)
    assert not cc.within(against(found, case, i), cc.LIMITS)
    end = cc.angle(found["q"][i, -1], case.rows[-1].q)
    assert end == pytest.approx(error, rel=0.02 if error > 1 else 0.1)  # two digits, or one, are printed


def test_nothing_passes_for_not_being_a_number():
    assert not cc.within({"attitude": np.nan}, cc.LIMITS) and cc.within({"attitude": 0.0}, cc.LIMITS)


def test_scipy_gives_the_printed_brick():
    found = cc.by_scipy(cc.tumble(), list(BRICK))
    rates, angles = zip(*BRICK.values())
    np.testing.assert_allclose(found["w"] / cc.DEG, rates, atol=1e-11)
    assert cc.angle(found["q"], [cc.quaternion(cc.euler(deg)) for deg in angles]).max() < 1e-8


def test_a_tool_that_is_right_agrees_once_the_turn_of_the_earth_is_removed(tmp_path):
    """A log made of DOP853, with angles against the frame below a body at rest among the stars at the equator."""
    t = np.arange(0, 31, 2.0)
    truth = cc.by_scipy(cc.tumble(), t)
    axes = "Roll", "Pitch", "Yaw"
    rows = []
    for now, q, w in zip(t, truth["q"], truth["w"] / cc.DEG):
        to_start = np.stack([cc.quat_rotate(cc.Quat.of(q), cc.Vec3.of(e)) for e in np.eye(3)], 1)
        below = cc.turn("x", np.degrees(EARTH_RATE * now)) @ to_start  # the Earth turns about north
        deg = np.degrees(
            [np.arctan2(below[2, 1], below[2, 2]), -np.arcsin(below[2, 0]), np.arctan2(below[1, 0], below[0, 0])]
        )
        angles = {f"eulerAngle_deg_{axis}": a for axis, a in zip(axes, deg)}
        rates = {f"bodyAngularRateWrtEi_deg_s_{axis}": a for axis, a in zip(axes, w)}
        rows.append({"time": now, "longitude_deg": 0.0, "latitude_deg": 0.0, **angles, **rates})
    with (tmp_path / "log.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    rate, attitude = nesc(tmp_path / "log.csv")
    assert rate < 1e-11 and attitude < 1e-9


# the pages that speak of it


CI = (ROOT / ".ci/run").read_text()
PAGE = (ROOT / "docs/guides/credibility.md").read_text()


def table_under(page: str, head: str) -> list[list[str]]:
    """The cells of the first table under a heading, without its head."""
    lines = page.partition(f"## {head}\n")[2].partition("\n|")[2].partition("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_ci_runs_the_cases():
    assert re.search(r"^python -m benchmarks\.check_cases$", CI, re.M) and "&& pytest\n" in CI


def test_every_evidence_cell_links_to_a_command_that_ci_runs():
    rows = table_under(PAGE, "The eight factors")
    assert len(rows) == 8
    for factor, _, evidence, gap in rows:
        links = re.findall(r"\[`([^`]+)`\]\(\.\./\.\./([^)]+)\)", evidence)
        assert links and gap, factor
        for command, path in links:
            assert (ROOT / path).exists(), path
            known = command == path == ".ci/run" or command == f"pytest {path}"
            assert known or (command in CI.splitlines() and command.split()[-1] == path[:-3].replace("/", ".")), command


@pytest.mark.parametrize("page", ["guides/credibility.md", "trust.md", "limits.md"])
def test_validated_and_flight_stand_in_negations_alone(page):
    text = re.sub(r"\s+", " ", re.sub(r"```.*?```", "", (ROOT / "docs" / page).read_text(), flags=re.S))
    for clause in re.split(r"[.;|:]|, (?:and|but) ", text):
        if re.search(r"\b(validated|flight|flown)\b", clause, re.I):
            assert re.search(r"\b(not|no|nor|never|nothing|none)\b", clause, re.I), clause


def test_the_page_shows_every_case_of_the_command():
    rows = table_under((ROOT / "docs/trust.md").read_text(), "Other people's cases")
    shown = [(row[0], row[1]) for row in rows if row[1] != "Basilisk"]
    listed = [(f"{c.name}, {', '.join(f'{r.t:g}' for r in c.rows)} s", c.source) for c in CASES]
    assert shown == [*listed, (f"Atmos_02 brick, {', '.join(map(str, BRICK))} s", "DOP853")]
    for row in rows:
        assert float(row[2]) <= (1e-8 if "brick" in row[0] else 1e-9) and all(row), row[0]
