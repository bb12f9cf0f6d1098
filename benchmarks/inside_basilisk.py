"""`jaxatt.loops.star_isolation` closed in Basilisk: ``python -m benchmarks.inside_basilisk [--runs N]`` (extra ``bench``).

Basilisk moves the satellite on its orbit under gravity, gravity gradient, a constant torque and the actuators' torque; its
gyro and its two star trackers read it, and it breaks its own gyro. Our computer (`jaxatt.basilisk`) filters, steers by the
roll filter's estimate and detects. White noise is added where readings are made, for the errors of Basilisk's sensors are
bounded random walks. Without noise the logs must be equal to 1e-9 (rates in rad/s, torques in N m, the evaluation relative to
its largest), with the same alarms; our share of noisy flights that detect, of ten times as many, must lie in the 95 %
interval of Basilisk's.
"""

from __future__ import annotations

import argparse
import time
from math import atan2, cos, sin
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxatt
from jaxatt import Fault, Quat, Reading, Vec3, basilisk, evaluation, on_axes, simulate
from jaxatt.attitude import mrp_from_quat, quat_conjugate, quat_from_mrp, quat_to_body
from jaxatt.loops import star_isolation as loop
from jaxatt.star_filters import LMMSE

LIMIT = 1e-9
ONSET, END, BIAS = 10.0, 20.0, 2.2e-5  # [s], [s], [rad/s] of the gyro about x in the detection study
PARAMS = loop.params._replace(feedback=1.0)  # the roll filter and the gyro steer


class Told(NamedTuple):
    """What the computer in Basilisk reports."""

    verdict: Any  # of `loop.decide`
    u: Vec3  # [N m]
    estimate: Quat  # of both filters
    readings: Any  # of which q and w are the truth


def decide(params, now, computer, readings):
    """The loop's computer and its command."""
    computer, verdict = loop.decide(params, now, computer, readings)
    u = loop.command(LMMSE, params, computer, readings)
    return computer, Told(verdict, u, LMMSE.attitude(computer.filters.mean), readings)


many = jax.vmap(decide, in_axes=(None, None, 0, 0))


def scenario_of(onset: float, bias: float, noisy: bool = True):
    """The loop's day with a biased gyro about x and no other fault."""
    day = loop.scenario._replace(star=loop.HEALTHY, gyro=on_axes(Fault())._replace(x=Fault(onset=onset, bias=bias)))
    return day if noisy else day._replace(std_gyro=0.0, std_star=0.0)


def flights(scenario, seconds: float, n: int = 1, seed: int = 0):
    """Times, computers and `Told`, (T, n, ...), of n satellites in Basilisk with the numbers of a scenario of the loop.

    One module steers them all: its ``decide`` is that of one satellite under `jax.vmap`.
    """
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        GravityGradientEffector,
        extForceTorque,
        imuSensor,
        spacecraft,
        starTracker,
    )
    from Basilisk.utilities import (  # pyright: ignore[reportMissingImports]
        SimulationBaseClass,
        macros,
        simIncludeGravBody,
    )

    sim, rng = SimulationBaseClass.SimBaseClass(), np.random.default_rng(seed)
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(loop.DT)))
    column = lambda v: [[float(a)] for a in v]
    keep = []

    def add(module, tag: str, priority: int):
        module.ModelTag = f"{tag} {len(keep)}"
        sim.AddModelToTask("task", module, priority)
        keep.append(module)
        return module

    rate = float(scenario.orbit_rate)
    stars = [Vec3(*(float(a[i]) for a in scenario.stars)) for i in range(2)]

    def satellite():
        """Spacecraft, gyro, both trackers and the message of the torque; at the start x is ahead and z down."""
        craft = add(spacecraft.Spacecraft(), "craft", 5)
        bodies = simIncludeGravBody.gravBodyFactory()
        earth = bodies.createEarth()
        earth.isCentralBody = True
        bodies.addBodiesTo(craft)
        keep.append(bodies)
        far = float(np.cbrt(earth.mu / rate**2))
        craft.hub.mHub, craft.hub.r_BcB_B = 1000.0, column([0, 0, 0])
        craft.hub.IHubPntBc_B = np.array(scenario.J).tolist()
        craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = column([0, 0, -far]), column([rate * far, 0, 0])
        craft.hub.sigma_BNInit, craft.hub.omega_BN_BInit = column(mrp_from_quat(scenario.q)), column(scenario.w)
        gradient = add(GravityGradientEffector.GravityGradientEffector(), "gradient", 4)
        gradient.addPlanetName(earth.planetName)
        craft.addDynamicEffector(gradient)
        gyro = add(imuSensor.ImuSensor(), "gyro", 3)
        trackers = [add(starTracker.StarTracker(), "tracker", 3) for _ in range(2)]
        for sensor in (gyro, *trackers):
            sensor.scStateInMsg.subscribeTo(craft.scStateOutMsg)
        torque, push = messaging.CmdTorqueBodyMsg(), add(extForceTorque.ExtForceTorque(), "push", 1)
        push.cmdTorqueInMsg.subscribeTo(torque)
        push.extTorquePntB_B = column(scenario.torque)
        craft.addDynamicEffector(push)
        return craft, gyro, trackers, torque

    fleet = [satellite() for _ in range(n)]

    def one(craft, gyro, trackers, _):
        state, rates, first = craft.scStateOutMsg.read(), gyro.sensorOutMsg.read(), len(computer.told) == 0
        half = 0.5 * atan2(state.r_BN_N[0], -state.r_BN_N[2])
        against = quat_conjugate(Quat(cos(half), 0.0, -sin(half), 0.0))  # of the orbit's frame
        seen = [quat_to_body(against * Quat(*t.sensorOutMsg.read().qInrtl2Case), s) for t, s in zip(trackers, stars)]
        w, s = scenario.std_gyro * rng.normal(size=3), scenario.std_star * rng.normal(size=(3, 2))
        return loop.Readings(
            Reading(Vec3(*(np.array(rates.AngVelPlatform) + w)), not first),  # it speaks from its second sample on
            Reading(Vec3(*(np.array(seen).T + s)), np.ones(2, bool)),
            against * quat_from_mrp(Vec3(*state.sigma_BN)),
            Vec3(*state.omega_BN_B),
        )

    def read():
        return jax.tree.map(lambda *a: np.stack(a), *(one(*parts) for parts in fleet))

    def write(_, told):
        torques = np.stack(told.u, axis=1).tolist()
        payload = lambda u: messaging.CmdTorqueBodyMsgPayload(torqueRequestBody=u)
        return [(message, payload(u)) for (*_, message), u in zip(fleet, torques)]

    start = loop.computer_of(*loop.init(LMMSE, 1, PARAMS, scenario))
    start = jax.tree.map(lambda a: np.broadcast_to(a, (n, *np.shape(a))), start)
    computer = basilisk.computer(many, PARAMS, start, dt=loop.DT, read=read, write=write)
    add(computer, "computer", 2)
    sim.InitializeSimulation()
    fault = scenario.gyro.x
    for until in (min(fault.onset, seconds), seconds):  # the tick of the onset is the first with the bias
        sim.ConfigureStopTime(macros.sec2nano(until - loop.DT))
        sim.ExecuteSimulation()
        for _, gyro, _, _ in fleet:
            gyro.senRotBias = [fault.bias, 0.0, 0.0]
    return computer.record()


def differences(seconds: float, onset: float) -> tuple[dict[str, float], int]:
    """The largest differences of one flight without noise, its gyro biased from onset on, from the loop's own log.

    And how many alarms of the two filters there are.
    """
    scenario = scenario_of(onset, BIAS, noisy=False)
    told = jax.tree.map(lambda a: a[:, 0], flights(scenario, seconds)[2])
    log = simulate(loop.system, PARAMS, scenario, jax.random.key(0), ticks=round(seconds / loop.DT))
    far = lambda a, b: max(float(np.abs(np.array(x) - np.array(y)).max()) for x, y in zip(a, b, strict=True))
    verdict = told.verdict
    found = {
        "attitude [1]": far(log.q, told.readings.q),
        "rate [rad/s]": far(log.w, told.readings.w),
        "estimates [1]": far(log.estimate, told.estimate),
        "torque [N m]": far(log.u, told.u),
        "evaluation J, of its largest": far([log.verdict.J], [verdict.J]) / float(np.max(log.verdict.J)),
        "ticks with another alarm": float(np.sum(log.verdict.alarm != verdict.alarm)),
        "ticks with another cause": float(np.sum(log.verdict.latched_cause != verdict.latched_cause)),
    }
    return found, int(verdict.alarm.sum())


def detected(n: int) -> int:
    """Of n noisy flights in Basilisk, how many alarm from the onset on."""
    t, _, told = flights(scenario_of(ONSET, BIAS), END, n)
    return int(told.verdict.alarm[t >= ONSET - loop.DT / 2].any(axis=(0, 2)).sum())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.inside_basilisk", description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="noisy flights in Basilisk; ten times as many of ours")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    print("One flight of 120 s without noise, the gyro biased from 60 s on, float64")
    found, alarms = differences(120.0, 60.0)
    good = alarms > 0
    print(f"  {'alarms':44}{alarms:12}", flush=True)
    for name, worst in found.items():
        good &= worst <= LIMIT
        print(f"  {name + ', largest difference' if '[' in name else name:44}{worst:12.2e}")
    begun, runs = time.process_time(), max(1, args.runs)
    theirs = detected(runs)
    spent = time.process_time() - begun
    n = 10 * runs
    scenarios = jax.tree.map(lambda a: np.broadcast_to(a, (n, *np.shape(a))), scenario_of(ONSET, BIAS))
    ticks = round(END / loop.DT)
    scores = jaxatt.sweep(loop.system, PARAMS, scenarios, jax.random.key(1), ticks=ticks, score=loop.score)
    ours = int(np.isfinite(scores.delay).any(axis=1).sum())
    print(f"A gyro biased by {BIAS:g} rad/s from {ONSET:g} to {END:g} s; Basilisk's flights took {spent:.0f} CPU s")
    spans = {}
    for name, hits, of in (("Basilisk", theirs, runs), ("jaxatt", ours, n)):
        spans[name] = evaluation.interval(hits, of)
        print(f"  {name}: {hits / of:.3f} of {of} detected, 95 %: {spans[name][0]:.3f} to {spans[name][1]:.3f}")
    low, high = spans["Basilisk"]
    if not good or not low <= ours / n <= high:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
