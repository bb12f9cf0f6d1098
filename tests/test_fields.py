"""What a field says of itself, and what is refused by it."""

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import check, fields
from jaxatt.check import finite, inertia, not_negative, positive
from jaxatt.engine import simulate, validated
from jaxatt.faults import Fault, on_axes
from jaxatt.loops import observer_pd
from jaxatt.sweeping import sweep
from jaxatt.vec import Mat3, Vec3

NAN = float("nan")


class Range(NamedTuple):
    low: Any = 0.0
    high: Any = 1.0

    def check(self, name):
        if check.concrete(self):
            check.each(f"{name}.high", "exceed the low end", self.high, np.asarray(self.high) > self.low)


class Data(NamedTuple):
    gain: Annotated[Any, "N m", positive] = 1.0
    speed: Annotated[Vec3, "rad/s", finite] = Vec3(0.0, 0.0, 0.0)
    momenta: Annotated[Any, "N m s", finite, ("n",)] = np.zeros(4)
    limits: Annotated[Any, "N m", ("n",), ()] = 1.0
    cov: Annotated[Any, "1", ("m", "m")] = np.eye(2)
    faults: Annotated[Vec3, "rad"] = on_axes(Fault())
    within: Annotated[Range, "m"] = Range()
    option: Annotated[Any, "m", positive] = None
    free: Any = 0.0


# what is known of a field


def test_a_field_has_a_unit_shapes_and_a_domain():
    known = fields.of(Data)
    assert known["gain"] == fields.Field(None, "N m", (), (positive,))
    assert known["speed"] == fields.Field(Vec3, "rad/s", (), (finite,))
    assert known["limits"] == fields.Field(None, "N m", (("n",), ()), ())
    assert known["free"] == fields.Field(None, None, (), ())
    assert list(known) == list(Data._fields)


def test_units_are_found_by_path_and_passed_down_to_what_has_none():
    units = fields.units(Data)
    assert units["gain"] == "N m" and units["speed.y"] == "rad/s" and units["within.low"] == "m"
    assert "free" not in units
    of_tree = fields.units(Data())
    assert of_tree["speed.y"] == "rad/s" and of_tree["within.low"] == "m"
    assert of_tree["faults.x.bias"] == "rad" and of_tree["faults.z.tau"] == "s" and of_tree["faults.y.scale"] == "1"


def test_units_of_a_matrix_are_those_of_its_nine_numbers():
    units = fields.units(observer_pd.params)
    assert {units[f"J.{row}.{column}"] for row in "xyz" for column in "xyz"} == {"kg m^2"}


def test_a_class_made_in_a_function_has_fields_too():
    class Local(NamedTuple):
        size: Annotated[Any, "m", positive] = 1.0

    assert fields.units(Local) == {"size": "m"}
    with pytest.raises(ValueError, match=r"^`it\.size` must be a positive number, but it is -1\.$"):
        fields.validate("it", Local(-1.0))


def test_names_that_only_a_function_knows_leave_the_fields_bare():
    class Local(NamedTuple):
        size: "Annotated[Nowhere, 'm']" = 1.0  # noqa: F821  # pyright: ignore[reportUndefinedVariable]

    assert fields.of(Local) == {"size": fields.Field(None, None, (), ())}
    fields.validate("it", Local(-1.0))


# what is refused


def batch(data, n):
    return jax.tree.map(lambda a: np.broadcast_to(np.asarray(a)[..., None], (*np.shape(a), n)), data)


GOOD = [
    Data(),
    Data(momenta=np.zeros(3), limits=np.ones(3)),
    Data(cov=np.eye(5)),
    Data(free=np.zeros((2, 3))),
    Data(option=None),
    Data(free=None),
    Data(speed=Vec3(1, 2, 3)),
]


@pytest.mark.parametrize("data", GOOD)
@pytest.mark.parametrize("n", [None, 2, 4])
def test_what_fits_passes(data, n):
    fields.validate("it", data if n is None else batch(data, n), n)


BAD = [
    (Data(gain=0.0), "`it.gain` must be a positive number, but it is 0{}."),
    (Data(speed=Vec3(0.0, NAN, 0.0)), "`it.speed.y` must be finite, but it is nan{}."),
    (Data(within=Range(2.0, 1.0)), "`it.within.high` must exceed the low end, but it is 1{}."),
    (Data(faults=Vec3(Fault(), Fault(tau=-1.0), Fault())), "`it.faults.y.tau` must be a positive number, but it is -1{}."),
    (Data(faults=on_axes(Fault(2.0, 1.0))), "`it.faults.x.end` must not lie before the onset, but it is 1{}."),
    (Data(momenta=np.array([0.0, 0.0, np.inf])), "`it.momenta[2]` must be finite, but it is inf{}."),
]  # fmt: skip


@pytest.mark.parametrize(("data", "message"), BAD)
def test_what_lies_outside_its_domain_is_refused_by_leaf_and_scenario(data, message):
    with pytest.raises(ValueError) as error:
        fields.validate("it", data)
    assert str(error.value) == message.format("")
    mixed = jax.tree.map(lambda good, bad: np.stack([good, good, bad], -1), Data(momenta=np.zeros(np.shape(data.momenta))), data)  # fmt: skip
    with check.scenarios(3), pytest.raises(ValueError) as error:
        fields.validate("it", mixed, 3)
    assert str(error.value) == message.format(" in scenario 2")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (Data(gain=np.ones(2)), "`it.gain` must have shape (): one scenario; `jaxatt.sweep` takes many, but it is of shape (2,)."),
        (Data(momenta=1.0), "`it.momenta` must have shape (n,), but it is of shape ()."),
        (Data(momenta=np.zeros(3), limits=np.ones(4)), "`it.limits` must have shape (3,) or (), but it is of shape (4,)."),
        (Data(cov=np.zeros((2, 3))), "`it.cov` must have shape (m, m), but it is of shape (2, 3)."),
        (Data(faults=on_axes(Fault(bias=np.ones(2)))), "`it.faults.x.bias` must have shape (): one scenario; `jaxatt.sweep` takes many, but it is of shape (2,)."),
    ],
)  # fmt: skip
def test_another_shape_is_refused(data, message):
    with pytest.raises(ValueError) as error:
        fields.validate("it", data)
    assert str(error.value) == message


def test_a_shape_of_many_is_told_with_the_scenarios_first():
    many = batch(Data(), 7)._replace(momenta=np.zeros((4, 2, 7)))
    with pytest.raises(ValueError) as error:
        fields.validate("it", many, 7)
    assert str(error.value) == "`it.momenta` must have shape (n,) in each scenario, but it is of shape (7, 4, 2)."


def test_another_type_is_refused():
    for bad in (np.zeros(3), (0.0, 0.0, 0.0), Mat3.of(np.eye(3))):
        with pytest.raises(TypeError, match=r"^`it\.speed` must be a Vec3, but it is "):
            fields.validate("it", Data(speed=bad))  # pyright: ignore[reportArgumentType]


def test_none_is_refused_where_it_is_not_the_default():
    for bad, leaf in ((Data(gain=None), "gain"), (Data(speed=Vec3(0.0, None, 0.0)), "speed.y")):
        with pytest.raises(TypeError, match=rf"^`it\.{leaf}` must be a number or an array, but it is None\.$"):
            fields.validate("it", bad)
    with pytest.raises(TypeError, match=r"^`it\.speed` must be a Vec3, but it is None\.$"):
        fields.validate("it", Data(speed=None))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("bad", [[0.0, 0.0], dict(a=0.0), "a"])
def test_what_is_no_array_is_refused(bad):
    for data, leaf in ((Data(momenta=bad), "momenta"), (Data(faults=on_axes(Fault(drift=bad))), r"faults\.x\.drift")):
        with pytest.raises(TypeError, match=rf"^`it\.{leaf}` must be a number or an array, but it is "):
            fields.validate("it", data)


def test_the_shape_of_a_field_holds_for_the_numbers_within():
    class Wheels(NamedTuple):
        fault: Annotated[Fault, "N m", ("n",)] = Fault()
        speed: Annotated[Any, "rad/s", ("n",)] = np.zeros(3)

    each = jax.tree.map(lambda a: np.full(3, a), Fault())
    fields.validate("it", Wheels(each))
    with pytest.raises(ValueError, match=r"^`it\.fault\.drift` must have shape \(3,\), but it is of shape \(2,\)\.$"):
        fields.validate("it", Wheels(each._replace(drift=np.zeros(2))))


def test_parts_in_tuples_are_looked_into_others_are_not():
    with pytest.raises(ValueError, match=r"^`it\[1\]\.gain` must be a positive number"):
        fields.validate("it", (3.0, Data(gain=-1.0)))
    fields.validate("it", dict(data=Data(gain=-1.0)))
    fields.validate("it", ())


def test_tracers_pass_their_domain_but_not_their_shape():
    f = jax.jit(lambda gain: fields.validate("it", Data(gain=gain)) or gain)
    assert f(-1.0) == -1
    with pytest.raises(ValueError, match=r"^`it\.gain` must have shape \(\)"):
        f(jnp.ones(3))


# at the verbs


def test_simulate_and_sweep_refuse_by_the_fields():
    loop, key = observer_pd, jax.random.key(0)
    with pytest.raises(
        ValueError,
        match=r"^`params\.k_q` must .* shape \(\): the same in all scenarios; `jaxatt\.varied` takes others, ",
    ):
        simulate(loop.system, loop.params._replace(k_q=np.ones(3)), loop.scenario, key, ticks=3)
    skew = Mat3.of(np.diag([1.0, 1.0, 3.0]))
    with pytest.raises(ValueError, match=r"^`scenario\.J` must have no principal moment above .*, but it is 1\.$"):
        simulate(loop.system, loop.params, loop.scenario._replace(J=skew), key, ticks=3)
    many = jax.vmap(lambda std: loop.scenario._replace(std_q=std))(np.array([0.0, 0.1, -0.1]))
    with pytest.raises(ValueError, match=r"^`scenario\.std_q` must not be negative, but it is -0\.1 in scenario 2\.$"):
        sweep(loop.system, loop.params, many, key, ticks=3, score=loop.score)


def test_validated_gives_arrays_of_one_floating_type():
    class Body(NamedTuple):
        J: Annotated[Mat3, "kg m^2", inertia] = Mat3.of(np.eye(3))
        on: Annotated[Any, "1"] = True
        count: Annotated[Any, "1", not_negative] = np.int32(3)

    system = observer_pd.system._replace(check=lambda params, scenario: None)
    params, scenario = validated(system, Range(1, np.float32(2)), Body(Mat3.of(np.eye(3, dtype=np.float32))))
    assert {a.dtype for a in jax.tree.leaves((params, scenario.J))} == {np.dtype(np.float32)}
    assert scenario.on.dtype == bool and scenario.count.dtype == np.int32
