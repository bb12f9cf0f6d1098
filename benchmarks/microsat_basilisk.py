"""The satellite of `jaxatt.loops.microsat` beside one of Basilisk's modules: ``python -m benchmarks microsat_basilisk``.

Extra ``bench``. Basilisk has no MEKF with a clone, no detectors of these kinds and no reconfiguration. Its nearest modules
are set up with the same inertia, wheels and their friction, orbit, disturbances, sensors, torquers and steps: RK4 with
0.1 s, all modules in one task at 10 Hz. Its unscented filter takes a star sample at every tick, for no module fills the
buffer of gyro packets that it wants between samples (it says so once, of its first tick); a row without a filter, the
attitude known, stands beside it. That both point is a row, too: the rms of the angle to the orbit's frame over the last
minute.
"""

from __future__ import annotations

import time
from functools import partial

import jax
import numpy as np

import jaxatt
from benchmarks.measure import cpu_ns
from benchmarks.microsat import N, equal
from jaxatt.attitude import mrp_error, mrp_from_matrix, mrp_inner
from jaxatt.loops import microsat as ms
from jaxatt.orbit import EARTH, MU, kepler
from jaxatt.vec import Mat3, Vec3, array, norm

SECONDS = 300.0
DEG = np.pi / 180


def basilisk(filtered: bool, seconds: float):
    """Basilisk's simulation, set up: what runs it, and then () -> rms angle [rad] to the orbit's frame of the last minute."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.fswAlgorithms import (  # pyright: ignore[reportMissingImports]
        attTrackingError,
        dipoleMapping,
        hillPoint,
        inertialUKF,
        mrpFeedback,
        mtbMomentumManagementSimple,
        rwMotorTorque,
        stComm,
        tamComm,
        torque2Dipole,
    )  # fmt: skip
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        GravityGradientEffector,
        MtbEffector,
        eclipse,
        exponentialAtmosphere,
        facetDragDynamicEffector,
        facetSRPDynamicEffector,
        imuSensor,
        magneticFieldCenteredDipole,
        magnetometer,
        reactionWheelStateEffector,
        simpleNav,
        spacecraft,
        starTracker,
    )  # fmt: skip
    from Basilisk.utilities import (  # pyright: ignore[reportMissingImports]
        SimulationBaseClass,
        macros,
        simIncludeGravBody,
        simIncludeRW,
    )

    p, s = ms.params, ms.scenario
    J, axes = np.asarray(array(s.J)), np.asarray(array(s.axes))
    hub = J + s.wheels.J * axes @ axes.T  # Basilisk's hub holds the wheels' axial inertia
    sim = SimulationBaseClass.SimBaseClass()
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(ms.DT)))
    keep = []  # Basilisk does not hold what only Python made

    def add(module, tag: str):
        module.ModelTag = tag
        sim.AddModelToTask("task", module, 1000 - len(keep))
        keep.append(module)
        return module

    def given(message, **what):
        payload = getattr(messaging, f"{message}Payload")(**what)
        keep.append(getattr(messaging, message)().write(payload))
        return keep[-1]

    # the truth
    craft = add(spacecraft.Spacecraft(), "craft")
    column = lambda v: [[float(a)] for a in v]
    r, v = (a[0] for a in kepler(ms.ORBIT, np.zeros(1)))
    craft.hub.mHub = 60.0
    craft.hub.r_BcB_B = column([0, 0, 0])
    craft.hub.IHubPntBc_B = hub.tolist()
    craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = column(r), column(v)
    up, north = (a / np.linalg.norm(a) for a in (r, np.cross(r, v)))
    orbit_frame = np.stack([up, np.cross(north, up), north], axis=1)  # columns: up, ahead, across
    start = mrp_from_matrix(Mat3.of(orbit_frame.tolist()))
    craft.hub.sigma_BNInit = column(start)
    craft.hub.omega_BN_BInit = column([0, 0, np.sqrt(MU / np.linalg.norm(r) ** 3)])
    bodies = simIncludeGravBody.gravBodyFactory()
    earth = bodies.createEarth()
    earth.isCentralBody = True
    bodies.addBodiesTo(craft)
    gradient = add(GravityGradientEffector.GravityGradientEffector(), "gradient")
    gradient.addPlanetName(earth.planetName)
    craft.addDynamicEffector(gradient)
    factory, friction = simIncludeRW.rwFactory(), s.wheels.friction
    for axis, h in zip(axes.T, np.asarray(s.h)):
        wheel = factory.create(
            "custom", axis.tolist(), Js=s.wheels.J, Omega_max=s.wheels.speed_max / macros.rpm2radsec,
            u_max=s.wheels.torque_max, useRWfriction=True, fCoulomb=friction.coulomb, fStatic=friction.stiction,
            betaStatic=friction.stribeck, cViscous=friction.viscous,
        )  # fmt: skip
        wheel.Omega = float(h / s.wheels.J)
    wheels = reactionWheelStateEffector.ReactionWheelStateEffector()
    factory.addToSpacecraft("wheels", wheels, craft)
    keep += [bodies, factory]
    # surroundings
    state = craft.scStateOutMsg
    field = add(magneticFieldCenteredDipole.MagneticFieldCenteredDipole(), "field")
    field.planetRadius, field.g10, field.g11, field.h11 = EARTH, -29404.8e-9, -1450.9e-9, 4652.5e-9
    air = add(exponentialAtmosphere.ExponentialAtmosphere(), "air")
    air.planetRadius, air.scaleHeight, air.baseDensity = EARTH, 63e3, 6.967e-13 * np.exp(500 / 63)
    for place in (field, air):
        place.addSpacecraftToModel(state)
    sun = given("SpicePlanetStateMsg", PositionVector=[1.496e11, 0.0, 0.0], PlanetName="sun")
    still = given(
        "SpicePlanetStateMsg", PositionVector=[0.0, 0.0, 0.0], J20002Pfix=np.eye(3).tolist(), PlanetName="earth"
    )
    shadow = add(eclipse.Eclipse(), "shadow")
    shadow.sunInMsg.subscribeTo(sun)
    shadow.addPlanetToModel(still)
    shadow.addSpacecraftToModel(state)
    drag = add(facetDragDynamicEffector.FacetDragDynamicEffector(), "drag")
    light = add(facetSRPDynamicEffector.FacetSRPDynamicEffector(), "light")
    facets = s.facets
    normals, arms = (np.stack(np.broadcast_arrays(*a), axis=-1) for a in (facets.normal, facets.arm))
    light.setNumFacets(len(normals))
    parts = (np.broadcast_to(a, len(normals)) for a in (facets.area, facets.drag, facets.specular, facets.diffuse))
    for normal, arm, area, cd, specular, diffuse in zip(normals, arms, *parts):
        drag.addFacet(float(area), float(cd), column(normal), column(arm))
        light.addFacet(
            float(area), np.eye(3).tolist(), column(normal), column([0, 0, 1]), column(arm), float(diffuse), float(specular)
        )  # fmt: skip
    drag.atmoDensInMsg.subscribeTo(air.envOutMsgs[0])
    light.sunInMsg.subscribeTo(sun)
    light.sunEclipseInMsg.subscribeTo(shadow.eclipseOutMsgs[0])
    bars = add(MtbEffector.MtbEffector(), "bars")
    for effector in (drag, light, bars):
        craft.addDynamicEffector(effector)
    # sensors
    nav = add(simpleNav.SimpleNav(), "nav")
    nav.scStateInMsg.subscribeTo(state)
    nav.sunStateInMsg.subscribeTo(sun)
    tracker = add(starTracker.StarTracker(), "tracker")
    tracker.scStateInMsg.subscribeTo(state)
    gyro = add(imuSensor.ImuSensor(), "gyro")
    gyro.scStateInMsg.subscribeTo(state)
    compass = add(magnetometer.Magnetometer(), "compass")
    compass.senNoiseStd = [float(s.std_field)] * 3
    compass.stateInMsg.subscribeTo(state)
    compass.magInMsg.subscribeTo(field.envOutMsgs[0])
    # on board
    stars = add(stComm.stComm(), "stars")
    stars.dcm_BP = np.eye(3).ravel().tolist()
    stars.stSensorInMsg.subscribeTo(tracker.sensorOutMsg)
    config = given("VehicleConfigMsg", ISCPntB_B=hub.ravel().tolist())
    wheel_config = factory.getConfigMessage()
    keep.append(wheel_config)
    attitude = nav.attOutMsg
    if filtered:
        ukf = add(inertialUKF.inertialUKF(), "ukf")
        ukf.alpha, ukf.beta, ukf.kappa, ukf.switchMag, ukf.maxTimeJump = 0.02, 2.0, 0.0, 1.2, 10.0
        sample = inertialUKF.STMessage()
        sample.noise = (np.eye(3) * (s.tracker.roll / 4) ** 2).ravel().tolist()
        sample.stInMsg.subscribeTo(stars.stAttOutMsg)
        ukf.STDatasStruct.STMessages, ukf.STDatasStruct.numST = [sample], 1
        keep.append(sample)
        ukf.stateInit = [a[0] for a in (*craft.hub.sigma_BNInit, *craft.hub.omega_BN_BInit)]
        ukf.covarInit = np.diag([1e-6] * 3 + [1e-8] * 3).ravel().tolist()
        ukf.qNoise = np.diag([1e-12] * 3 + [1e-12] * 3).ravel().tolist()
        smooth = inertialUKF.LowPassFilterData()
        smooth.hStep, smooth.omegCutoff = ms.DT, 15 / (2 * np.pi)
        ukf.gyroFilt = [smooth] * 3
        ukf.massPropsInMsg.subscribeTo(config)
        ukf.rwParamsInMsg.subscribeTo(wheel_config)
        ukf.rwSpeedsInMsg.subscribeTo(wheels.rwSpeedOutMsg)
        ukf.gyrBuffInMsg.subscribeTo(given("AccDataMsg"))
        attitude = ukf.navStateOutMsg
    aim = add(hillPoint.hillPoint(), "aim")
    aim.transNavInMsg.subscribeTo(nav.transOutMsg)
    aim.celBodyInMsg.subscribeTo(given("EphemerisMsg"))
    error = add(attTrackingError.attTrackingError(), "error")
    error.attNavInMsg.subscribeTo(attitude)
    error.attRefInMsg.subscribeTo(aim.attRefOutMsg)
    law = add(mrpFeedback.mrpFeedback(), "law")
    mean = np.trace(J) / 3
    law.K, law.P, law.Ki = 4 * p.kp * mean, p.kd * mean, -1.0  # no integral
    law.guidInMsg.subscribeTo(error.attGuidOutMsg)
    law.vehConfigInMsg.subscribeTo(config)
    law.rwParamsInMsg.subscribeTo(wheel_config)
    law.rwSpeedsInMsg.subscribeTo(wheels.rwSpeedOutMsg)
    share = add(rwMotorTorque.rwMotorTorque(), "share")
    share.controlAxes_B = np.eye(3).ravel().tolist()
    share.rwParamsInMsg.subscribeTo(wheel_config)
    share.vehControlInMsg.subscribeTo(law.cmdTorqueOutMsg)
    wheels.rwMotorCmdInMsg.subscribeTo(share.rwMotorTorqueOutMsg)
    told = add(tamComm.tamComm(), "told")
    told.dcm_BS = np.eye(3).ravel().tolist()
    told.tamInMsg.subscribeTo(compass.tamDataOutMsg)
    unload = add(mtbMomentumManagementSimple.mtbMomentumManagementSimple(), "unload")
    unload.Kp = p.k_unload
    unload.rwParamsInMsg.subscribeTo(wheel_config)
    unload.rwSpeedsInMsg.subscribeTo(wheels.rwSpeedOutMsg)
    dipole = add(torque2Dipole.torque2Dipole(), "dipole")
    dipole.tauRequestInMsg.subscribeTo(unload.tauMtbRequestOutMsg)
    dipole.tamSensorBodyInMsg.subscribeTo(told.tamOutMsg)
    spread = add(dipoleMapping.dipoleMapping(), "spread")
    spread.steeringMatrix = np.eye(3).ravel().tolist()
    bar_config = given(
        "MTBArrayConfigMsg", numMTB=3, GtMatrix_B=np.eye(3).ravel().tolist(), maxMtbDipoles=[p.moment_max] * 3
    )
    spread.dipoleRequestBodyInMsg.subscribeTo(dipole.dipoleRequestOutMsg)
    spread.mtbArrayConfigParamsInMsg.subscribeTo(bar_config)
    bars.mtbCmdInMsg.subscribeTo(spread.dipoleRequestMtbOutMsg)
    bars.mtbParamsInMsg.subscribeTo(bar_config)
    bars.magInMsg.subscribeTo(field.envOutMsgs[0])
    add(wheels, "wheels")  # last: it reads the command that the others have just given
    log, wanted = (m.recorder(macros.sec2nano(1.0)) for m in (state, aim.attRefOutMsg))
    for recorder in (log, wanted):
        sim.AddModelToTask("task", recorder)
    sim.InitializeSimulation()
    sim.ConfigureStopTime(macros.sec2nano(seconds))

    def angle():
        is_, should = (Vec3.of(np.asarray(a)[-60:].T) for a in (log.sigma_BN, wanted.sigma_RN))
        off = 4 * np.arctan(norm(mrp_inner(mrp_error(is_, should))))
        return float(np.sqrt(np.mean(off**2)))

    angle.keep = keep  # pyright: ignore[reportFunctionMemberAccess]
    return sim.ExecuteSimulation, angle


def rows(quick: bool):
    """CPU time per tick of Basilisk with and without its filter and of jaxatt, and the ratios."""
    seconds, repeats = (120.0, 1) if quick else (SECONDS, 3)
    ticks, theirs = round(seconds / ms.DT), {}
    for name, filtered in (("without a filter", False), ("with its unscented filter", True)):
        spent = []
        for _ in range(repeats):
            run, angle = basilisk(filtered, seconds)
            begun = time.process_time()
            run()
            spent.append(time.process_time() - begun)
        theirs[name] = float(np.median(spent)) / ticks * 1e9
        yield {"name": f"Basilisk, {name}, tick", "value": theirs[name], "unit": "CPU ns"}
        yield {"name": f"Basilisk, {name}, angle, rms of the last minute", "value": angle() / DEG, "unit": "deg"}
    for real in (np.float32, np.float64):
        params, scenarios = equal(N, real)
        run = partial(jaxatt.sweep, ms.system, params, scenarios, jax.random.key(0), ticks=ticks, score=ms.score)
        label = f"{np.dtype(real).name}, N = {N}"
        ours = cpu_ns(partial(run, progress=False), N * ticks, repeats)
        yield {"name": f"jaxatt, tick, {label}", "value": ours, "unit": "CPU ns"}
        for name, ns in theirs.items():
            yield {"name": f"Basilisk {name} / jaxatt, {label}", "value": ns / ours, "unit": "x"}
