"""A computer inside Basilisk: a rigid body steered there flies as in our own loop. Skipped where there is no Basilisk."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import Quat, System, Vec3, basilisk, simulate
from jaxatt.attitude import quat_from_mrp, quat_normalised, quat_rate
from jaxatt.bodies import body_acceleration
from jaxatt.vec import Mat3, zeros

pytestmark = pytest.mark.short
J = Mat3(Vec3(12.0, 1.0, -0.5), Vec3(1.0, 10.0, 0.2), Vec3(-0.5, 0.2, 8.0))
SIGMA, W = Vec3(0.2, -0.1, 0.3), Vec3(0.02, -0.03, 0.01)
DT, TICKS = 0.1, 60


class Computer(NamedTuple):
    total: Any  # [rad s] of the first component, which moves between ticks
    u: Any  # [N m]


def decide(params, now, computer, y):
    q, w = y
    u = params * (-2.0 * q.v) - 6.0 * w - Vec3(0.01 * computer.total, 0.0, 0.0)
    return computer._replace(u=u), {"u": u, "late": now.t >= 2.0, "q": q, "w": w}


def computer_flow(params, computer, y):
    return {"total": y[0].x}


def ours():
    def init(params, scenario):
        return dict(q=quat_from_mrp(SIGMA), w=W, total=0.0), dict(u=zeros(), x=0.0)

    def tick(params, scenario, now, x, z, noise):
        x = x | dict(q=quat_normalised(x["q"]))
        computer, log = decide(params, now, Computer(x["total"], z["u"]), (x["q"], x["w"]))
        return x, dict(u=computer.u, x=x["q"].x), log

    def flow(params, scenario, t, x, z):
        return dict(q=quat_rate(x["q"], x["w"]), w=body_acceleration(x["w"], z["u"], J), total=z["x"])

    return simulate(System(init, tick, flow, dt=DT), 1.5, (), jnp.zeros((TICKS, 0)), ticks=TICKS)


def inside(period=DT):
    """The simulation, and our computer in it."""
    pytest.importorskip("Basilisk")
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import extForceTorque, spacecraft  # pyright: ignore[reportMissingImports]
    from Basilisk.utilities import SimulationBaseClass, macros  # pyright: ignore[reportMissingImports]

    sim, column = SimulationBaseClass.SimBaseClass(), lambda v: [[float(a)] for a in v]
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(period)))
    body, push, torque = spacecraft.Spacecraft(), extForceTorque.ExtForceTorque(), messaging.CmdTorqueBodyMsg()
    body.ModelTag, push.ModelTag = "body", "push"
    body.hub.mHub, body.hub.r_BcB_B, body.hub.IHubPntBc_B = 100.0, column([0, 0, 0]), np.array(J).tolist()
    body.hub.sigma_BNInit, body.hub.omega_BN_BInit = column(SIGMA), column(W)
    push.cmdTorqueInMsg.subscribeTo(torque)
    body.addDynamicEffector(push)

    def read():
        state = body.scStateOutMsg.read()
        return quat_from_mrp(Vec3(*state.sigma_BN)), Vec3(*state.omega_BN_B)

    def write(computer, log):
        return [(torque, messaging.CmdTorqueBodyMsgPayload(torqueRequestBody=np.array(log["u"]).tolist()))]

    computer = basilisk.computer(decide, 1.5, Computer(0.0, zeros()), dt=DT, read=read, write=write, flow=computer_flow)
    for priority, module in ((3, body), (2, computer), (1, push)):
        sim.AddModelToTask("task", module, priority)
    sim.InitializeSimulation()
    sim.ConfigureStopTime(macros.sec2nano((TICKS - 1) * DT))
    return sim, push, computer  # Basilisk holds no module alive


def test_a_body_steered_inside_basilisk_flies_as_in_our_loop():
    sim, _push, computer = inside()
    sim.ExecuteSimulation()
    (t, computers, told), log = computer.record(), ours()
    np.testing.assert_allclose(t, DT * np.arange(TICKS), rtol=1e-12)
    np.testing.assert_array_equal(told["late"], log["late"])
    for name in ("q", "w", "u"):
        np.testing.assert_allclose(np.array(told[name]), np.array(log[name]), atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(computers.u, told["u"])
    assert abs(np.array(log["u"])[:, -1]).max() < 0.5 * abs(np.array(log["u"])[:, 0]).max()  # it has steered
    sim.InitializeSimulation()
    assert computer.told == [] and float(computer.computer.total) == 0.0


def test_a_task_of_another_period_is_refused(capfd):
    sim, *_alive = inside(0.2)
    with pytest.raises(RuntimeError):
        sim.ExecuteSimulation()
    said = capfd.readouterr().err
    assert (
        "`dt` must be the period of the task, so that tick 1 comes at 100000000 ns, but it is at 200000000 ns." in said
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(dt=-1.0), "`dt` must be a positive number"),
        (dict(dt=1 / 3), "`dt` must be a whole number of nanoseconds, but it is 0.3333"),
        (dict(read=None), "`read` must be a function"),
        (dict(start=Computer("a", 0.0)), "`start.total` must be a number"),
        (dict(substeps=0), "`substeps` must be a whole number"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message):
    start = Computer(0.0, Quat(1.0, 0.0, 0.0, 0.0))
    given: dict[str, Any] = dict(decide=decide, params=1.0, start=start, dt=DT, read=lambda: ()) | change
    with pytest.raises((ValueError, TypeError), match=message) as refusal:
        basilisk.computer(**given)
    assert "\n" not in str(refusal.value)
