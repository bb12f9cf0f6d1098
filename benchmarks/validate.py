"""jaxatt against Basilisk: the same spacecraft in both, differences and speed side by side.

``python -m benchmarks.validate [--quick] [--out FILE]`` (extra ``bench``) runs four cases over 300 s with the same RK4
step of 0.1 s and prints the largest differences: torque-free tumbling, a body driven by four reaction wheels, MRP
feedback through an ideal torque, and MRP feedback through the wheels. Then it times the last one, in steps per
CPU-second, for one scenario and for a batch: Basilisk in one process and in a pool of processes, batched NumPy,
diffrax and jaxatt. It fails where an attitude (MRP) or a rate [rad/s] differs by more than 1e-11.

Two conventions must meet. Basilisk's hub inertia holds the wheels, spin axes included, and its state is the wheel's
speed relative to the hub; here J is the rest, without the wheels' inertia about their spin axes, and h their whole
momentum about these, h = Js (Omega + g . w). The change of state is linear, under which RK4 gives the same step.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks.measure import cpu_ns
from benchmarks.measure import seconds as seconds_of
from jaxatt import System, scores, simulate, sweep
from jaxatt.attitude import mrp_error, mrp_inner, mrp_rate
from jaxatt.bodies import body_acceleration
from jaxatt.controllers import pd
from jaxatt.vec import Mat3, Vec3, array, project, resultant, zeros

DT = 0.1  # [s] control period and integration step
SECONDS = 300
LIMIT = 1e-11  # [1] MRP, [rad/s]
HUB = np.array([[90.0, 2.0, -1.0], [2.0, 80.0, 3.0], [-1.0, 3.0, 60.0]])  # [kg m^2] wheels included
AXES = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [2**0.5] * 4]) / 2  # (3, 4) spin axes
SHARES = np.linalg.pinv(AXES).T  # (3, 4) what each wheel takes of a torque
SPIN = 0.05  # [kg m^2] Js, of a wheel about its spin axis
K, P = 3.5, 30.0  # [N m], [N m s] gains
TARGET = np.array([0.2, -0.1, 0.3])  # [1] MRP
AMPLITUDE = np.array([0.1, -0.08, 0.06, 0.09])  # [N m] of the motors' torque in the open loop
FREQUENCY = np.array([0.05, 0.11, 0.17, 0.23])  # [rad/s]
Q0, W0 = np.array([0.3, -0.4, 0.5]), np.array([0.06, -0.05, 0.09])  # [1], [rad/s]
OMEGA0 = np.array([100.0, -50.0, 80.0, 20.0])  # [rad/s] wheel speeds


# jaxatt


class Params(NamedTuple):
    """What drives the body; the defaults do nothing."""

    k: Any = 0.0  # [N m] gain on the MRP error
    p: Any = 0.0  # [N m s] gain on the rate
    q_d: Vec3 = zeros()  # [1] target MRP
    amplitude: Any = np.zeros(4)  # (4,) [N m] of sinusoidal motor torques
    frequency: Any = np.zeros(4)  # (4,) [rad/s]


class Scenario(NamedTuple):
    """Start and spacecraft."""

    q: Vec3  # [1] MRP
    w: Vec3  # [rad/s]
    h: Any  # (4,) [N m s] of the wheels about their spin axes
    J: Mat3  # [kg m^2] without the wheels' inertia about their spin axes


class X(NamedTuple):
    """Continuous state."""

    q: Vec3  # [1] MRP
    w: Vec3  # [rad/s]
    h: Any  # (4,) [N m s]


class Z(NamedTuple):
    """Held between ticks."""

    u: Vec3  # [N m] torque on the body
    motor: Any  # (4,) [N m] torque on the wheels


class Log(NamedTuple):
    """The truth at a tick."""

    q: Vec3
    w: Vec3
    h: Any


def init(params: Params, s: Scenario):
    """x, z at the start."""
    return X(s.q, s.w, s.h), Z(zeros(), jnp.zeros(4))


def tick(params: Params, s: Scenario, now, x: X, z: Z, noise, *, wheels: bool):
    """The torque of the next period, by an ideal actuator or through the wheels."""
    x = x._replace(q=mrp_inner(x.q))
    u = pd(mrp_error(x.q, params.q_d), x.w, params.k, params.p)
    if wheels:
        motor = params.amplitude * jnp.sin(params.frequency * now.t) - project(SHARES, u)
        z = Z(zeros(), motor)
    else:
        z = Z(u, jnp.zeros(4))
    return x, z, Log(x.q, x.w, x.h)


def flow(params: Params, s: Scenario, t, x: X, z: Z, *, wheels: bool) -> X:
    """dx/dt."""
    if wheels:
        w = body_acceleration(x.w, -resultant(AXES, z.motor), s.J, resultant(AXES, x.h))
    else:
        w = body_acceleration(x.w, z.u, s.J)
    return X(mrp_rate(x.q, x.w), w, z.motor)


def score(params: Params, s: Scenario, now, log: Log):
    """What the timed sweep keeps: the end."""
    return jax.tree.map(scores.final, log)


BODY = System(init, partial(tick, wheels=False), partial(flow, wheels=False), dt=DT)
WHEELED = System(init, partial(tick, wheels=True), partial(flow, wheels=True), dt=DT)
IDLE, OPEN = Params(), Params(amplitude=AMPLITUDE, frequency=FREQUENCY)
FEEDBACK = Params(k=K, p=P, q_d=Vec3.of(TARGET))


def scenario_of(q, w, h, wheels: bool = True) -> Scenario:
    """The scenario of an MRP (3,), a rate (3,) and wheel momenta (4,)."""
    spin = SPIN if wheels else 0.0
    return Scenario(Vec3.of(q), Vec3.of(w), h, Mat3.of(HUB - spin * AXES @ AXES.T))


def ours(loop: System, params: Params, seconds: float) -> dict[str, np.ndarray]:
    """Attitude (T, 3), rate (T, 3) and wheel speed (T, 4) by jaxatt."""
    s = scenario_of(Q0, W0, SPIN * (OMEGA0 + W0 @ AXES), loop is WHEELED)
    log = simulate(loop, params, s, jax.random.key(0), ticks=round(seconds / DT) + 1)
    q, w, h = (np.asarray(a) for a in (array(log.q).T, array(log.w).T, log.h))
    return {"attitude": q, "rate": w, **({"wheel speed": h / SPIN - w @ AXES} if loop is WHEELED else {})}


# Basilisk


def basilisk(loop: str, seconds: float, record: bool = True, start=(Q0, W0, OMEGA0)):
    """Basilisk's simulation of a case, set up; () -> attitude, rate and wheel speed at the recorded times.

    All modules run in one task, the spacecraft first: it integrates over the past period with the torque commanded
    at that period's start, so that the command is held and not late.
    """
    from Basilisk.architecture import messaging, sysModel  # pyright: ignore[reportMissingImports]
    from Basilisk.fswAlgorithms import (  # pyright: ignore[reportMissingImports]
        attTrackingError,
        inertial3D,
        mrpFeedback,
        rwMotorTorque,
    )  # fmt: skip
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        extForceTorque,
        reactionWheelStateEffector,
        simpleNav,
        spacecraft,
    )  # fmt: skip
    from Basilisk.utilities import SimulationBaseClass, macros, simIncludeRW  # pyright: ignore[reportMissingImports]

    sim = SimulationBaseClass.SimBaseClass()
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(DT)))
    modules, keep = [], []  # Basilisk does not hold what only Python made

    def add(module, tag: str):
        module.ModelTag = tag
        sim.AddModelToTask("task", module, 1000 - len(modules))
        modules.append(module)
        return module

    craft = add(spacecraft.Spacecraft(), "craft")
    column = lambda v: [[float(a)] for a in v]
    q, w, omega = start
    craft.hub.mHub = 500.0
    craft.hub.r_BcB_B = column([0, 0, 0])
    craft.hub.IHubPntBc_B = HUB.tolist()
    craft.hub.sigma_BNInit, craft.hub.omega_BN_BInit = column(q), column(w)
    wheels = None
    if "wheels" in loop:
        factory = simIncludeRW.rwFactory()
        for axis, speed in zip(AXES.T, omega):
            wheel = factory.create("custom", axis.tolist(), Js=SPIN, useMaxTorque=False)
            wheel.Omega = float(speed)
        wheels = reactionWheelStateEffector.ReactionWheelStateEffector()
        factory.addToSpacecraft("wheels", wheels, craft)
        keep.append(factory)
    if "feedback" in loop:
        nav = add(simpleNav.SimpleNav(), "nav")
        nav.scStateInMsg.subscribeTo(craft.scStateOutMsg)
        aim = add(inertial3D.inertial3D(), "aim")
        aim.sigma_R0N = TARGET.tolist()
        error = add(attTrackingError.attTrackingError(), "error")
        error.attNavInMsg.subscribeTo(nav.attOutMsg)
        error.attRefInMsg.subscribeTo(aim.attRefOutMsg)
        law = add(mrpFeedback.mrpFeedback(), "law")
        law.K, law.P, law.Ki = K, P, -1.0  # no integral
        law.guidInMsg.subscribeTo(error.attGuidOutMsg)
        config = messaging.VehicleConfigMsg().write(messaging.VehicleConfigMsgPayload(ISCPntB_B=HUB.ravel().tolist()))
        law.vehConfigInMsg.subscribeTo(config)
        keep.append(config)
        if wheels is None:
            actuator = add(extForceTorque.ExtForceTorque(), "torque")
            actuator.cmdTorqueInMsg.subscribeTo(law.cmdTorqueOutMsg)
            craft.addDynamicEffector(actuator)
        else:
            share = add(rwMotorTorque.rwMotorTorque(), "share")
            share.controlAxes_B = np.eye(3).ravel().tolist()
            wheel_config = factory.getConfigMessage()
            keep.append(wheel_config)
            share.rwParamsInMsg.subscribeTo(wheel_config)
            share.vehControlInMsg.subscribeTo(law.cmdTorqueOutMsg)
            wheels.rwMotorCmdInMsg.subscribeTo(share.rwMotorTorqueOutMsg)
    elif wheels is not None:

        class Sines(sysModel.SysModel):
            def __init__(self):
                super().__init__()
                self.out = messaging.ArrayMotorTorqueMsg()

            def Reset(self, nanos):
                pass

            def UpdateState(self, nanos):
                torque = AMPLITUDE * np.sin(FREQUENCY * (nanos * macros.NANO2SEC))
                payload = messaging.ArrayMotorTorqueMsgPayload(motorTorque=torque.tolist())
                self.out.write(payload, nanos, self.moduleID)

        sines = add(Sines(), "sines")
        wheels.rwMotorCmdInMsg.subscribeTo(sines.out)
    if wheels is not None:
        add(wheels, "wheels")  # last: it reads the command that the others have just given
    log = craft.scStateOutMsg.recorder()
    speeds = wheels.rwSpeedOutMsg.recorder() if wheels is not None else None
    if record:
        sim.AddModelToTask("task", log)
        if speeds is not None:
            sim.AddModelToTask("task", speeds)
    sim.InitializeSimulation()
    sim.ConfigureStopTime(macros.sec2nano(seconds))

    def run():
        sim.ExecuteSimulation()
        if not record:
            end = craft.scStateOutMsg.read()
            return {"attitude": np.array(end.sigma_BN), "rate": np.array(end.omega_BN_B)}
        out = {"attitude": np.array(log.sigma_BN), "rate": np.array(log.omega_BN_B)}
        if speeds is not None:
            out["wheel speed"] = np.array(speeds.wheelSpeeds)[:, :4]
        return out

    keep.append(modules)
    run.keep = keep  # pyright: ignore[reportFunctionMemberAccess]
    return run


# the same loop on plain arrays: state (10,) or (10, n) of q, w, h


def plain(xp, h, J):
    """tick(state) -> state, motor torque and flow(state, motor) of the closed loop with wheels, components first."""
    J_inv, axes, share = np.linalg.inv(J), AXES, SHARES.T
    dot = lambda a, b: (a * b).sum(0)
    cross = partial(xp.cross, axis=0)
    mul = lambda m, v: xp.einsum("ij,j...->i...", m, v)
    target = xp.asarray(TARGET).reshape(3, *(1,) * (h.ndim - 1))
    dd = dot(target, target)

    def tick(state):
        q, w, h = state[:3], state[3:6], state[6:]
        qq = dot(q, q)
        q = xp.where(qq > 1, -q / xp.where(qq > 1, qq, 1), q)
        qq = dot(q, q)
        down = 1 + dd * qq + 2 * dot(target, q)
        e = ((1 - dd) * q - (1 - qq) * target + 2 * cross(q, target)) / down
        ee = dot(e, e)
        e = xp.where(ee > 1, -e / xp.where(ee > 1, ee, 1), e)
        return xp.concatenate([q, w, h]), mul(share, K * e + P * w)

    def flow(state, motor):
        q, w, h = state[:3], state[3:6], state[6:]
        dq = ((1 - dot(q, q)) * w + 2 * cross(q, w) + 2 * dot(q, w) * q) / 4
        dw = mul(J_inv, -mul(axes, motor) - cross(w, mul(J, w) + mul(axes, h)))
        return xp.concatenate([dq, dw, motor])

    return tick, flow


def by_numpy(start, ticks: int):
    """() -> state (10, n) at the end by batched NumPy."""
    J = HUB - SPIN * AXES @ AXES.T
    tick, flow = plain(np, start[6:], J)

    def run():
        x = start
        for _ in range(ticks):
            x, motor = tick(x)
            k1 = flow(x, motor)
            k2 = flow(x + DT / 2 * k1, motor)
            k3 = flow(x + DT / 2 * k2, motor)
            k4 = flow(x + DT * k3, motor)
            x = x + DT / 6 * (k1 + 2 * (k2 + k3) + k4)
        return tick(x)[0]

    return run


def by_diffrax(start, ticks: int):
    """() -> state (10, n) at the end by diffrax: its solver's step scanned over the periods, vmapped over scenarios.

    A single run keeps the state of every period, as our `simulate` does. It has no classical Runge-Kutta method; the tableau makes it one.
    """
    import diffrax  # pyright: ignore[reportMissingImports]

    classical = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1, 2, 2, 1]) / 6, b_error=np.zeros(4), c=np.array([0.5, 0.5, 1.0]),
    )  # fmt: skip

    class RK4(diffrax.AbstractERK):
        tableau = classical
        interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

        def order(self, terms):
            return 4

    J = HUB - SPIN * AXES @ AXES.T
    tick, flow = plain(jnp, start[6:, 0], J)
    term, solver = diffrax.ODETerm(lambda t, x, motor: flow(x, motor)), RK4()

    def one(x):
        def step(x, k):
            x, motor = tick(x)
            t = k * DT
            state = solver.init(term, t, t + DT, x, motor)
            ahead, *_ = solver.step(term, t, t + DT, x, motor, state, made_jump=False)
            return ahead, x if start.shape[1] == 1 else None

        end, log = jax.lax.scan(step, x, jnp.arange(ticks))
        return tick(end)[0], log

    run = jax.jit(jax.vmap(one))
    each = jnp.asarray(start.T)
    return lambda: run(each)[0].T


def by_jaxatt(start, ticks: int):
    """() -> state (10, n) at the end by jaxatt: a sweep, or one run where there is one scenario."""
    key = jax.random.key(0)
    scenarios = jax.vmap(lambda x: scenario_of(x[:3], x[3:6], x[6:]))(start.T)

    def one():
        s = jax.tree.map(lambda a: a[0], scenarios)
        log = simulate(WHEELED, FEEDBACK, s, key, ticks=ticks + 1)  # with its log, as one runs a single scenario
        return np.concatenate([np.stack(log.q)[:, -1:], np.stack(log.w)[:, -1:], log.h[-1:].T])

    def many():
        end = sweep(WHEELED, FEEDBACK, scenarios, key, ticks=ticks + 1, score=score, progress=False)
        return np.concatenate([np.stack(end.q), np.stack(end.w), end.h.T])

    return one if start.shape[1] == 1 else many


def starts(n: int, seed: int = 0):
    """n starts: MRP (3, n), rates (3, n), wheel speeds (4, n)."""
    rng = np.random.default_rng(seed)
    near = lambda a, std: a[:, None] + std * rng.standard_normal((len(a), n))
    return near(Q0, 0.1), near(W0, 0.02), near(OMEGA0, 20.0)


def momenta(q, w, omega):
    """The state (10, n) of a start."""
    return np.concatenate([q, w, SPIN * (omega + AXES.T @ w)])


def share_of_pool(columns, seconds: float):
    """A worker's part of a batch in Basilisk: CPU and wall seconds of the runs, and their ends (6, n)."""
    runs = [basilisk("wheels, feedback", seconds, record=False, start=c) for c in columns]
    cpu, wall = time.process_time(), time.perf_counter()
    ends = [run() for run in runs]
    spent = time.process_time() - cpu, time.perf_counter() - wall
    return *spent, np.stack([np.concatenate([e["attitude"], e["rate"]]) for e in ends], axis=1)


# tables


CASES = {
    "torque-free": (BODY, IDLE, "free"),
    "wheel-driven": (WHEELED, OPEN, "wheels"),
    "MRP feedback": (BODY, FEEDBACK, "feedback"),
    "MRP feedback by wheels": (WHEELED, FEEDBACK, "wheels, feedback"),
}


def differences(seconds: float):
    """Rows of the largest differences over a run, case by case."""
    for name, (loop, params, theirs) in CASES.items():
        a, b = ours(loop, params, seconds), basilisk(theirs, seconds)()
        for field in a:
            worst = float(np.abs(a[field] - b[field]).max())
            yield {"case": name, "field": field, "difference": worst, "size": float(np.abs(b[field]).max())}


def speeds(quick: bool):
    """Rows of steps per CPU-second and per second of wall time of MRP feedback by wheels, and the difference at the end.

    What it takes to set a simulation up, or to compile it, is left out. Basilisk runs fewer scenarios: its time is
    proportional to their number.
    """
    seconds, workers = (30.0, 2) if quick else (300.0, os.cpu_count() or 1)
    ticks = round(seconds / DT)
    one, small, large = starts(1), starts(16 if quick else 64), starts(256 if quick else 1024)
    columns = lambda s: [tuple(a[:, i] for a in s) for i in range(s[0].shape[1])]

    def row(program, n, spent, wall, difference):
        per = lambda t: n * ticks / t
        return {"program": program, "scenarios": n, "cpu": per(spent), "wall": per(wall), "difference": difference}

    def timed(program, make, start):
        run, n = make(momenta(*start), ticks), start[0].shape[1]
        end = np.asarray(run())[:6]
        wall = seconds_of(run)
        *_, reference = share_of_pool(columns(start)[:4], seconds)
        difference = np.abs(end[:, : reference.shape[1]] - reference).max()
        return row(program, n, cpu_ns(run, 1, 1 if quick else 3) / 1e9, wall, float(difference))

    for start in (one, small):
        cpu, wall, _ = share_of_pool(columns(start), seconds)
        yield row("Basilisk", start[0].shape[1], cpu, wall, 0.0)
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        parts = [columns(small)[i::workers] for i in range(workers)]
        cpu, wall, _ = zip(*pool.starmap(share_of_pool, [(p, seconds) for p in parts], 1))
        pool.close()
        pool.join()
    yield row(f"Basilisk, {workers} processes", small[0].shape[1], sum(cpu), max(wall), 0.0)
    for program, make in (("NumPy", by_numpy), ("diffrax", by_diffrax), ("jaxatt", by_jaxatt)):
        for start in (one, large):
            yield timed(program, make, start)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.validate", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="time 30 s runs of fewer scenarios")
    parser.add_argument("--out", type=Path, default=Path("results/validate.json"), help="tables as JSON")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    print(f"Python {platform.python_version()}, JAX {jax.__version__}; RK4, step {DT} s, {SECONDS} s")
    print(f"\n  {'largest difference to Basilisk':38}{'difference':>12}{'largest value':>16}")
    table = []
    for row in differences(SECONDS):
        table.append(row)
        print(f"  {row['case'] + ', ' + row['field']:38}{row['difference']:12.1e}{row['size']:16.4g}", flush=True)
    bad = [row for row in table if row["field"] != "wheel speed" and not row["difference"] <= LIMIT]
    print(f"  attitude and rate: {'all' if not bad else 'NOT all'} within {LIMIT:g}")
    print(f"\n  {'MRP feedback by wheels':28}{'scenarios':>10}{'steps/CPU-s':>14}{'steps/s':>12}{'difference':>12}")
    timing = []
    for row in speeds(args.quick):
        timing.append(row)
        numbers = f"{row['scenarios']:10}{row['cpu']:14.3g}{row['wall']:12.3g}{row['difference']:12.1e}"
        print(f"  {row['program']:28}{numbers}", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"jax": jax.__version__, "differences": table, "speeds": timing}, indent=1) + "\n")
    if bad:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
