"""The yardstick's world a second time: truth by Basilisk, sensors, filter, law and two detectors in NumPy.

``python -m benchmarks.yardstick_basilisk [--days N] [--seconds S]`` (extra ``bench``). Basilisk integrates one spacecraft a
day under an external torque; all else is written here from docs/yardstick.md, without a line of `jaxatt.yardstick`'s loop.
Both meet the same days and the same noise, in float64: as many healthy days as faulty ones. It fails where an attitude
differs by more than 1e-9 rad, a score of chi2_10 or parity by more than 1e-6 of its peak, or an alarm comes in another
packet. Basilisk holds a torque over its step of 0.1 s; the disturbance, which moves meanwhile, is its mean by Simpson's
rule, as in our Runge-Kutta step.
"""

from __future__ import annotations

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import simulate
from jaxatt.noise import noise_of
from jaxatt.yardstick import leo4, tune, worlds
from jaxatt.yardstick.kinds import effects

KEY = 20
CELLS = (("gyro_bias", 9.35), ("star_bias", 42.5), ("wheel_offset", 0.36), ("wheel_loss", 1.0))
LIMITS = {"chi2_10": 72.0, "parity": 4.28}  # of the scores: alarms above
ATTITUDE, SCORE = 1e-9, 1e-6  # [rad]; of the peak
J0 = np.array([[15.0, 2.0, -1.0], [2.0, 27.0, 3.0], [-1.0, 3.0, 30.0]])
INVERSE = np.linalg.inv(J0)
ANGLES = np.deg2rad([45, 135, 225, 315])
G = np.stack([np.sqrt(2 / 3) * np.cos(ANGLES), np.sqrt(2 / 3) * np.sin(ANGLES), np.full(4, np.sqrt(1 / 3))], 1)
STD_GYRO = np.deg2rad(0.02) / 60 / np.sqrt(0.1)  # [rad/s]
RRW = np.deg2rad(0.3) / 3600 / 60  # [rad/s^1.5]
STAR = 10 * np.pi / 648000  # [rad]


def steady():
    """Gains of attitude and bias of the filter of an axis, and its innovation's variance, by running it until it stays."""
    F, Q = np.array([[1, -0.1], [0, 1]]), np.diag([0.75 * (STD_GYRO * 0.1) ** 2, 0.075 * RRW**2])
    P = np.diag([1e-8, 1e-12])
    for _ in range(20_000):
        for _ in range(5):
            P = F @ P @ F.T + Q
        S = P[0, 0] + STAR**2
        K = P[:, 0] / S
        P = P - np.outer(K, P[0])
    return *K, S


K1, K2, S = steady()


# quaternions, scalar first, a day a row


def mul(p, q):
    w = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    v = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    return np.column_stack([w, v])


def conj(p):
    return p * [1, -1, -1, -1]


def rot(v):
    h2 = np.sum(v * v, axis=1, keepdims=True) / 4
    return np.hstack([1 - h2 / 2 + h2 * h2 / 24, v / 2 * (1 - h2 / 6)])


def turn(p):
    return 2 * p[:, 1:] * np.where(p[:, :1] < 0, -1, 1)


def quat(sigma):
    ss = np.sum(sigma * sigma, axis=1, keepdims=True)
    return np.hstack([1 - ss, 2 * sigma]) / (1 + ss)


class Craft:
    """Sensors, filter and law of n days side by side, and the telemetry that they leave."""

    def __init__(self, day, noise):
        self.day, self.noise, self.k = day, noise, 0  # noise: (n, packets, 55)
        n = len(day.mode)
        self.bias, (q, _, _) = np.array(day.bias), self.aim(0.0)
        self.hat = mul(q, rot(-np.column_stack(day.turn)))
        self.b = 0.75 * self.bias @ G - np.column_stack(day.bias_error)
        self.attitude, self.innovation, self.parity = [], [], []
        self.sum = np.zeros(n)

    def aim(self, t):
        axis, swing, w = np.column_stack(self.day.axis), np.where(self.day.mode > 0, self.day.swing, 0), 2 * np.pi / 300
        th = swing * np.sin(w * t + self.day.psi)
        q = np.column_stack([np.cos(th / 2), np.sin(th / 2)[:, None] * axis])
        return q, (swing * w * np.cos(w * t + self.day.psi))[:, None] * axis, (-w * w * th)[:, None] * axis

    def command(self, q, w):
        """Body torque [N m] over the next tick, disturbance included, of true attitude (n, 4) and rate (n, 3)."""
        day, (packet, j) = self.day, divmod(self.k, 5)
        t, noise = 0.1 * self.k, self.noise[:, packet, 11 * j : 11 * j + 11]
        if j == 0:
            self.attitude.append(q)
            on = t >= day.star.onset
            error = STAR * noise[:, 8:] + on * day.star.bias
            nu = turn(mul(conj(self.hat), mul(q, rot(error))))
            self.hat = self.hat / np.linalg.norm(self.hat, axis=1, keepdims=True)
            self.hat, self.b = mul(self.hat, rot(K1 * nu)), self.b + K2 * nu
            self.innovation.append(nu)
            self.sum = np.zeros(len(q))
        y = (1 + day.scale) * (w @ G.T) + self.bias + STD_GYRO * noise[:, :4] + (t >= day.gyro.onset) * day.gyro.bias
        self.bias = self.bias + RRW * np.sqrt(0.1) * noise[:, 4:8]
        self.sum = self.sum + y @ [0.5, -0.5, 0.5, -0.5] / 5
        if j == 4:
            self.parity.append(self.sum)
        w_hat, (q_aim, w_aim, a_aim) = 0.75 * y @ G - self.b, self.aim(t)
        gyroscopic = np.cross(w_hat, w_hat @ J0)
        u = (a_aim - 0.01 * turn(mul(conj(q_aim), self.hat)) - 0.18 * (w_hat - w_aim)) @ J0 + gyroscopic
        tau = np.clip(0.75 * u @ G.T, -0.03, 0.03)
        self.hat = mul(self.hat, rot(0.1 * w_hat + 0.005 * (tau @ G - gyroscopic) @ INVERSE))
        on = t >= day.wheel.onset
        tau = np.where(on, day.wheel.scale, 1) * tau + on * day.wheel.bias
        constant, wave, phi = (np.column_stack(a) for a in (day.constant, day.wave, day.phi))
        sines = [np.sin(1.1e-3 * (t + part) + phi) for part in (0.0, 0.05, 0.1)]
        self.k += 1
        return tau @ G + constant + wave * (sines[0] + 4 * sines[1] + sines[2]) / 6

    def scores(self, sd):
        """chi2_10 and parity, (packets, n) each; sd [rad/s] of the parity residual."""
        nis = np.sum(np.square(self.innovation), axis=2) / S
        B, hp = np.zeros(nis.shape[1]), []
        for k, p in enumerate(self.parity):
            hp.append(p - B)
            B = B + hp[-1] * max(1 / (k + 1), 1 / 600)
        window = lambda a: np.array([np.sum(a[max(0, k - 9) : k + 1], axis=0) for k in range(len(a))])
        return {"chi2_10": window(nis), "parity": np.abs(window(np.array(hp))) / (sd * np.sqrt(10))}


def basilisk(day, noise, ticks: int) -> Craft:
    """All days in one simulation, a spacecraft each."""
    from Basilisk.architecture import messaging, sysModel  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import extForceTorque, spacecraft  # pyright: ignore[reportMissingImports]
    from Basilisk.utilities import SimulationBaseClass, macros  # pyright: ignore[reportMissingImports]

    sim = SimulationBaseClass.SimBaseClass()
    sim.CreateNewProcess("process").addTask(sim.CreateNewTask("task", macros.sec2nano(0.1)))
    craft, n = Craft(day, noise), len(day.mode)
    q, w, _ = craft.aim(0.0)
    D, bodies, commands, keep = np.column_stack(day.stretch), [], [], []
    column = lambda v: [[float(a)] for a in v]
    for i in range(n):
        body, push = spacecraft.Spacecraft(), extForceTorque.ExtForceTorque()
        body.ModelTag, push.ModelTag = f"craft{i}", f"torque{i}"
        body.hub.mHub = 100.0
        body.hub.r_BcB_B = column([0, 0, 0])
        body.hub.IHubPntBc_B = (D[i][:, None] * J0 * D[i]).tolist()
        body.hub.sigma_BNInit, body.hub.omega_BN_BInit = column(q[i, 1:] / (1 + q[i, 0])), column(w[i])
        command = messaging.CmdTorqueBodyMsg()
        push.cmdTorqueInMsg.subscribeTo(command)
        body.addDynamicEffector(push)
        sim.AddModelToTask("task", body, 10 * n - i)
        sim.AddModelToTask("task", push, 8 * n - i)
        bodies.append(body)
        commands.append(command)
        keep.append(push)

    class Board(sysModel.SysModel):
        """Reads all states, writes all torques; the spacecraft then integrate over the period that follows."""

        def Reset(self, nanos):
            pass

        def UpdateState(self, nanos):
            if craft.k >= ticks:
                return
            states = [body.scStateOutMsg.read() for body in bodies]
            torque = craft.command(
                quat(np.array([s.sigma_BN for s in states])), np.array([s.omega_BN_B for s in states])
            )
            for message, u in zip(commands, torque.tolist()):
                message.write(messaging.CmdTorqueBodyMsgPayload(torqueRequestBody=u), nanos, self.moduleID)

    board = Board()
    board.ModelTag = "board"
    sim.AddModelToTask("task", board, 9 * n)
    sim.InitializeSimulation()
    sim.ConfigureStopTime(macros.sec2nano(0.1 * (ticks - 1)))
    sim.ExecuteSimulation()
    return craft


def ours(day, noise, packets: int):
    """Attitudes (packets, n, 4) and the scores of our loop and detectors in float64."""
    log = jax.jit(jax.vmap(lambda day, noise: simulate(leo4.system, leo4.params, day, noise, ticks=packets)))(
        day, noise
    )
    found, wide = {}, lambda tree: jax.tree.map(lambda a: jnp.asarray(a, float), tree)
    for name in LIMITS:
        d = tune(name)

        def play(telemetry, d=d):
            step = lambda z, packet: d.step(wide(d.params), z, packet)
            return jax.lax.scan(step, wide(d.init(d.params)), telemetry)[1].score

        found[name] = np.asarray(jax.jit(jax.vmap(play))(log.telemetry)).T
    return np.moveaxis(np.stack(log.q, axis=-1), 0, 1), found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.yardstick_basilisk", description=__doc__)
    parser.add_argument("--days", type=int, default=64, help="healthy ones, and as many faulty ones, a multiple of 4")
    parser.add_argument("--seconds", type=float, default=900.0, help="of a day; onsets are moved to fit a shorter one")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    packets, n, key = round(args.seconds / leo4.PACKET), max(1, args.days // len(CELLS)), jax.random.key(KEY)
    world, numbers = worlds.WORLDS["leo4"], np.arange(2 * n * len(CELLS))
    cells = [None] * (n * len(CELLS)) + [cell for cell in CELLS for _ in range(n)]
    both = jax.tree.map(lambda *a: np.array(a, np.float32), *(effects(cell) for cell in cells))
    day = jax.tree.map(lambda a: np.asarray(a, float), worlds.days(world, key, numbers, both))
    share = args.seconds / (world.warmup + world.window)
    shifted = lambda fault: fault._replace(onset=share * fault.onset)
    day = day._replace(**{unit: shifted(getattr(day, unit)) for unit in world.units})
    noise = np.stack([np.asarray(noise_of(leo4.system, key, int(i), packets), float) for i in numbers])
    begun = time.process_time()
    theirs = basilisk(day, noise, packets * leo4.TICKS)
    spent = time.process_time() - begun
    q, found = ours(day, noise, packets)
    off = [np.abs(turn(mul(conj(a), b))).max() for a, b in zip(q, theirs.attitude, strict=True)]
    print(f"{len(numbers)} days of {args.seconds:g} s, Basilisk and NumPy {spent:.0f} CPU s, float64")
    print(f"  {'attitude, largest difference [rad]':44}{max(off):12.2e}")
    good = max(off) <= ATTITUDE
    for name, wanted in theirs.scores(float(tune("parity").params)).items():
        worst = np.abs(found[name] - wanted).max() / wanted.max()
        alarms = wanted > LIMITS[name]
        same = np.array_equal(alarms, found[name] > LIMITS[name])
        print(f"  {name + ', largest difference of the peak':44}{worst:12.2e}")
        print(f"  {name + ', packets with an alarm':44}{alarms.sum():12}  {'the same' if same else 'NOT the same'}")
        good &= bool(worst <= SCORE and same)
    if not good:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
