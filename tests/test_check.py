"""The grammar of a refusal, and what each check lets pass."""

import importlib
import runpy
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import check
from jaxatt.vec import Mat3, Quat, Vec3

NAN, INF = float("nan"), float("inf")


def diagonal(*moments):
    return Mat3.of(np.diag(np.asarray(moments, float)))


PLATE = diagonal(1.0, 2.0, 3.0)
THIN = diagonal(1.0, 2.0, 3.1)
SKEW = Mat3.of([[2.0, 0.1, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
FLAT = diagonal(0.0, 1.0, 1.0)

# domain, what passes, what is refused and in what words
DOMAINS = [
    (check.positive, [1.0, 1e-300, 3], [(0.0, "`x` must be a positive number, but it is 0."), (INF, "but it is inf"), (NAN, "nan")]),
    (check.not_negative, [0.0, INF, True], [(-1e-9, "`x` must not be negative, but it is -1e-09."), (NAN, "nan")]),
    (check.limit, [1.0, INF], [(0.0, "`x` must be greater than 0 (inf for no limit), but it is 0."), (NAN, "nan")]),
    (check.flag, [0.0, 1, True], [(0.5, "`x` must be one of (0, 1), but it is 0.5."), (NAN, "nan")]),
    (check.acute, [0.1, 1.57], [(1.6, "`x` must lie in (0, 1.5708), 0 to 90 deg in rad, but it is 1.6."), (0.0, "but it is 0"), (NAN, "nan")]),
    (check.share, [0.0, 1.0, 0.3], [(1.1, "`x` must lie in [0, 1], but it is 1.1."), (-0.1, "-0.1"), (NAN, "nan")]),
    (check.finite, [0.0, -1e300, Vec3(1.0, 2.0, 3.0)], [(INF, "`x` must be finite, but it is inf."), (Vec3(1.0, NAN, 1.0), "`x.y` must be finite, but it is nan.")]),
    (check.a_number, [0.0, -INF], [(NAN, "`x` must be a number, but it is nan."), (dict(a=[1.0, NAN]), "`x['a'][1]` must be a number")]),
    (check.unit, [Vec3(0.6, 0.0, -0.8), Quat(1.0, 0.0, 0.0, 0.0)], [(Vec3(1.0, 1.0, 0.0), "`|x|` must be 1, but it is 1.41421."), (Vec3(1.0, NAN, 0.0), "`x.y` must be finite")]),
    (check.mrp, [Vec3(0.0, 0.0, 10.0), Vec3(0.0, 0.0, 0.0)], [(Vec3(90.0, 0.0, 0.0), "`|x|` must be at most 10 (an MRP is tan(angle/4), 1 for half a turn), but it is 90."), (Vec3(NAN, 0.0, 0.0), "`x.x` must be finite")]),
    (check.inertia, [PLATE, diagonal(1.0, 1.0, 1.0), diagonal(1e-9, 2e-9, 3e-9)], [
        (THIN, "`x` must have no principal moment above the sum of the other two (no body is thinner than a plate; excess 0), but it is 0.1."),
        (SKEW, "`x` must be symmetric (largest difference to its transpose 0), but it is 0.1."), (FLAT, "`x` must be positive definite (smallest principal moment > 0), but it is 0."),
        (diagonal(1.0, -1.0, 1.0), "positive definite (smallest principal moment > 0), but it is -1."), (diagonal(1.0, INF, 1.0), "`x.y.y` must be finite, but it is inf."),
    ]),
]  # fmt: skip
GOOD = [(domain, value) for domain, passes, _ in DOMAINS for value in passes]
BAD = [(domain, value, message) for domain, _, refused in DOMAINS for value, message in refused]


@pytest.mark.parametrize(("domain", "value"), GOOD)
def test_what_lies_in_the_domain_passes(domain, value):
    domain("x", value)
    domain("x", jax.tree.map(lambda a: jnp.full(3, a), value))


@pytest.mark.parametrize(("domain", "value", "message"), BAD)
def test_what_lies_outside_is_refused_in_one_line(domain, value, message):
    with pytest.raises(ValueError) as error:
        domain("x", value)
    assert message in str(error.value) and "\n" not in str(error.value) and "scenario" not in str(error.value)


@pytest.mark.parametrize(("domain", "value", "message"), BAD)
def test_of_many_scenarios_the_first_bad_one_is_named(domain, value, message):
    good = next(passes[0] for other, passes, _ in DOMAINS if other is domain)
    if jax.tree.structure(good) != jax.tree.structure(value):
        good = jax.tree.map(lambda a: 0.0, value)
    many = jax.tree.map(lambda a, b: np.array([a, a, b, a, b]), good, value)
    with check.scenarios(5), pytest.raises(ValueError, match=r" in scenario 2\.$"):
        domain("x", many)


@pytest.mark.parametrize(("domain", "value", "message"), BAD)
def test_tracers_pass(domain, value, message):
    jax.jit(lambda value: domain("x", value))(value)


@pytest.mark.parametrize("domain", [domain for domain, *_ in DOMAINS])
@pytest.mark.parametrize("value", ["a", 1j, np.array([None])])
def test_what_holds_no_real_numbers_is_refused(domain, value):
    with pytest.raises(TypeError, match=r"^`x(\.\w)*` must hold real numbers, but it is "):
        domain("x", Mat3(*[Vec3(value, value, value)] * 3) if domain is check.inertia else Vec3(value, value, value) if domain in (check.unit, check.mrp) else value)  # fmt: skip


# where a number stands


@pytest.mark.parametrize(
    ("n", "shape", "message"),
    [
        (None, (3,), "`x[1]` must be finite, but it is nan."),
        (None, (), "`x` must be finite, but it is nan."),
        (3, (3,), "`x` must be finite, but it is nan in scenario 1."),
        (3, (2, 3), "`x[0]` must be finite, but it is nan in scenario 1."),
        (5, (2, 3), "`x[0, 1]` must be finite, but it is nan."),  # is the same for all scenarios
    ],
)
def test_a_message_tells_the_component_and_the_scenario(n, shape, message):
    value = np.zeros(shape)
    value[(0,) * (value.ndim - 1) + (1,) * (value.ndim > 0)] = NAN
    with check.scenarios(n), pytest.raises(ValueError) as error:
        check.finite("x", value)
    assert str(error.value) == message


def test_the_number_of_scenarios_holds_within_its_block_alone():
    with pytest.raises(ZeroDivisionError), check.scenarios(3):
        raise ZeroDivisionError
    with pytest.raises(ValueError, match=r"^`x\[1\]` must be positive, but it is 0\.$"):
        check.each("x", "be positive", np.array([1.0, 0.0, 1.0]), [True, False, True])


def test_intervals_name_the_bound_that_was_met():
    check.between("x", np.array([0.1, 0.4]), 0, np.array([0.2, 0.5]), "for short")
    with pytest.raises(ValueError, match=r"^`x\[1\]` must lie in \(0, 0\.5\), for short, but it is 0\.6\.$"):
        check.between("x", np.array([0.1, 0.6]), 0, np.array([0.2, 0.5]), "for short")
    with pytest.raises(ValueError, match=r"^`x` must be greater than 2 \(for short\), but it is 2\.$"):
        check.above("x", 2.0, 2, "for short")


def test_moments_are_the_eigenvalues_ascending():
    a = np.array([[3.0, 0.2, 0.1], [0.2, 4.0, 0.3], [0.1, 0.3, 5.0]])
    one = check.moments("J", Mat3.of(a))
    assert one is not None
    np.testing.assert_allclose(one, np.linalg.eigvalsh(a), rtol=1e-12)
    two = check.moments("J", jax.tree.map(lambda a: a * np.array([1.0, 2.0]), Mat3.of(a)))
    assert two is not None and two.shape == (3, 2)
    assert jax.jit(lambda m: check.moments("J", m) is None)(Mat3.of(a))


# one value


@pytest.mark.parametrize(
    ("f", "value", "error", "message"),
    [
        (check.number, np.ones(1), ValueError, r"`x` must be one number, but it is an array of shape \(1,\) and type float64"),
        (check.whole, True, ValueError, "`x` must be a whole number of at least 1, but it is True"),
        (check.whole, 2**31, ValueError, "`x` must be less than 2147483648, but it is 2147483648"),
        (check.wholes, [], ValueError, r"`x` must hold at least one whole number, but it is \[\]"),
        (check.wholes, [1, 0.5], ValueError, r"`x\[1\]` must be a whole number of at least 1, but it is 0\.5"),
        (check.place, 3, TypeError, "`x` must be a path, but it is 3"),
        (check.place, "a\0", TypeError, r"`x` must be a path, but it is 'a\\x00'"),
        (check.mapping, [1], TypeError, r"`x` must be a mapping, such as a dict, but it is \[1\]"),
        (check.function, "f", TypeError, "`x` must be a function, but it is 'f'"),
    ],
)  # fmt: skip
def test_one_value_is_refused(f, value, error, message):
    with pytest.raises(error, match=f"^{message}\\.$"):
        f("x", value)


def test_one_value_passes():
    assert check.number("x", np.float32(2)) == 2.0 and isinstance(check.number("x", 1), float)
    assert check.whole("x", np.int64(7)) == 7 and check.whole("x", 0, 0) == 0
    assert check.wholes("x", (1, 2)) == [1, 2]
    assert check.place("x", "a") == check.place("x", Path("a"))


def test_a_long_value_is_cut_to_one_line():
    said = check.short("a\nb" * 99)
    assert len(said) == 80 and "\n" not in said and said.endswith("...")
    assert check.short(np.zeros((3, 2))) == "an array of shape (3, 2) and type float64"


# params and scenarios


def test_leaves_become_arrays_of_the_one_floating_type():
    narrow = dict(a=np.float32(1), b=2, c=True, d=np.arange(2), e=jnp.ones(2, jnp.float32))
    (params, scenario) = check.converted(narrow, (0.5,))
    assert [a.dtype for a in jax.tree.leaves((params, scenario))] == [np.float32, np.float32, bool, np.int64, np.float32, np.float32]  # fmt: skip
    assert isinstance(params["e"], jax.Array) and isinstance(params["d"], np.ndarray)
    assert check.converted(0.5, np.float64(1))[0].dtype == np.float64


@pytest.mark.parametrize("leaf", ["a", object(), 1j, 10**400, np.array(["a"]), np.zeros(2, "datetime64[s]")])
def test_a_leaf_that_is_no_number_is_refused_by_its_path(leaf):
    with pytest.raises(TypeError, match=r"^`params\['w'\]\.y` must be a number or an array, but it is "):
        check.converted(dict(w=Vec3(0.0, leaf, 0.0)), ())
    with pytest.raises(TypeError, match=r"^`scenario\[0\]` must be float32 or float64, but it is float16\.$"):
        check.converted((), (np.float16(1),))


def test_the_number_of_scenarios_is_that_of_every_leaf():
    assert check.batch_size("scenarios", dict(a=np.zeros(5), b=np.zeros((5, 3)), c=None)) == 5
    with pytest.raises(ValueError, match=r"^`scenarios\['b'\]` must lead with the same 5 scenarios .* of shape \(3, 5\)\.$"):  # fmt: skip
        check.batch_size("scenarios", dict(a=np.zeros(5), b=np.zeros((3, 5))))


def test_a_run_in_float32_can_be_warned_of():
    with pytest.warns(UserWarning, match=r"^It drifts\. Run in float64: jax\.config\.update\('jax_enable_x64', True\)\.$"):  # fmt: skip
        check.precise("It drifts", np.float32(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check.precise("It drifts", 1.0)


def test_memory_is_known_and_what_exceeds_it_is_refused(monkeypatch):
    assert check.free_memory() > 1e6
    monkeypatch.setattr(check, "free_memory", lambda: 2e9)
    check.fits_memory("`ticks` = 3", 2 * 10**9, "ask for fewer")
    with pytest.raises(ValueError, match=r"^`ticks` = 3 takes 3 GB, but 2 GB of memory are free: ask for fewer\.$"):
        check.fits_memory("`ticks` = 3", 3 * 10**9, "ask for fewer")


def test_a_class_that_was_reloaded_is_told_apart(tmp_path, monkeypatch):
    (tmp_path / "reloaded_loop.py").write_text(
        "from typing import NamedTuple\nclass Scenario(NamedTuple):\n    a: float = 1.0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("reloaded_loop")
    old = module.Scenario()
    importlib.reload(module)
    with pytest.raises(
        TypeError, match="`scenario` must be a Scenario, but it is of a Scenario that has been defined anew"
    ):
        check.kind("scenario", old, module.Scenario)
    with pytest.raises(TypeError, match=r"`scenario` must be a Scenario, but it is Vec3\("):
        check.kind("scenario", Vec3(1.0, 2.0, 3.0), module.Scenario)


def test_params_are_no_scenario_however_many_there_are():
    """Five entries of params that five scenarios share: the entry is named, not a scenario."""
    bad = np.array([1.0, 1.0, 1.0, 1.0, -1.0])
    with check.scenarios(5, params=(1.0,)):
        with pytest.raises(ValueError, match=r"`params\.P0\[4\]` must not be negative, but it is -1\."):
            check.not_negative("params.P0", bad)
        with pytest.raises(ValueError, match=r"`\|params\.q\|\[4\]` must be 1, but it is 2\."):
            check.unit("params.q", (np.array([1.0, 1.0, 1.0, 1.0, 2.0]),))
        with pytest.raises(ValueError, match=r"`scenario\.a` must not be negative, but it is -1 in scenario 4\."):
            check.not_negative("scenario.a", bad)
    with check.scenarios(5), pytest.raises(ValueError, match=r"`params\.k` must .* in scenario 4\."):
        check.not_negative("params.k", bad)  # of a varied loop


def test_a_warning_points_to_the_line_of_the_user(tmp_path):
    """From a file outside the package, through any number of ours."""
    file = tmp_path / "flight.py"
    file.write_text(
        "import numpy as np\nfrom jaxatt.attitude import quat_from_vector\nfrom jaxatt.loops import star_isolation as loop\n"
        "from jaxatt.engine import validated\nfrom jaxatt.vec import Vec3\n\noff = Vec3(*map(float, quat_from_vector(Vec3(0.1, 0.0, 0.0))[1:]))\n"
        "q = loop.scenario.q._replace(w=(1 - off @ off) ** 0.5, x=off.x, y=off.y, z=off.z)\n\n"
        "def fly():\n    return validated(loop.system, loop.params, loop.scenario._replace(q=q))\n\nfly()\n"
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        runpy.run_path(str(file))
    assert told and {(w.filename, w.lineno) for w in told} == {(str(file), 11)}
