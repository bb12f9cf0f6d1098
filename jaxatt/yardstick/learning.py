"""Train the learned row by gradient: days of leo4 with faults of the public catalogue, key and sizes public, no test day.

Each round simulates days afresh: a fifth without a fault, each of the others with one of a kind and a public size drawn evenly. A
step of the descent reads the next hundred seconds of many days, each at another hour, and the state goes on from step to step:
a unit that learns from short windows alone drifts over a long day. The loss is the mean of -ln of the probability given to
what is true at each packet, no fault or one of the faulty channels. A day is read from a packet drawn evenly from the warm-up, and
at every packet from there on healthy and faulty days weigh alike: a unit that counts packets gains nothing.

May import: gru, recording, worlds, kinds, leo4, leo4_days, metrics, check, compiling, noise, resuming, sweeping.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxatt import check
from jaxatt.compiling import jitted
from jaxatt.noise import one_key
from jaxatt.resuming import mark_of, replaced
from jaxatt.sweeping import progress_bar
from jaxatt.yardstick import gru, leo4_days, recording, worlds
from jaxatt.yardstick.gru import CLASSES, HIDDEN, UNITS, Gru
from jaxatt.yardstick.kinds import effects
from jaxatt.yardstick.leo4 import PACKET
from jaxatt.yardstick.leo4_days import SIZED
from jaxatt.yardstick.metrics import HORIZON

LENGTH = 200  # [packets] of a day in one step
PARTS = leo4_days.PACKETS // LENGTH  # steps of a day
JUDGED = round(HORIZON / PACKET)  # [packets] from the onset
SKIPPED = round(leo4_days.WARMUP / PACKET)  # [packets] at most, before the first that is read
HEAVIEST = 20.0  # weight of a packet over the mean, at most
NEVER = 10 * leo4_days.PACKETS  # onset of a day without a fault
QUICKEST, SLOWEST = 2.0, 80.0  # [packets] memories of the units at the start of the training


class Plan(NamedTuple):
    """How much is trained: ``rounds`` of so many days, each met ``passes`` times, ``batch`` days side by side."""

    rounds: int = 6
    days: int = 4096
    passes: int = 4
    batch: int = 252
    rate: float = 4e-3  # of Adam, after a rise over 100 steps, or a quarter of all; falls to 0 by a cosine

    @property
    def steps(self) -> int:
        """Of a round; days still under way at its end are left."""
        return PARTS * self.passes * self.days // self.batch


SHIPPED = Plan()  # of the numbers in the package


class Trained(NamedTuple):
    """What a training gives."""

    params: Gru
    loss: Any  # (rounds,) mean of each round [nat a packet]


class Days(NamedTuple):
    """Days to learn from."""

    r: Any  # (n, 1800, 7) residuals
    onset: Any  # (n,) number of the first packet that the fault has touched; NEVER without a fault
    channels: Any  # (n, 11) bool


def drawn(key, n: int) -> Days:
    """n days, a fifth of them without a fault; of the others the kinds evenly, and the public sizes of each."""
    cells = [(kind, size) for kind, sizes in SIZED.items() for size in sizes]
    cells += [None] * (len(cells) // 4)
    table = jax.tree.map(lambda *a: np.array(a, np.float32), *(effects(cell) for cell in cells))
    at = np.asarray(jax.random.randint(jax.random.fold_in(key, 1), (n,), 0, len(cells), jnp.int32))
    world = worlds.WORLDS["leo4"]
    days = worlds.days(world, key, np.arange(n), jax.tree.map(lambda a: a[at], table))
    onset = np.floor((worlds.onset_of(world, days) + leo4_days.WARMUP) / PACKET)
    onset = np.where(np.isfinite(onset), onset, NEVER).astype(int)
    return Days(recording.residuals_of(days, key), onset, worlds.true_channels(world, days))


class Stretch(NamedTuple):
    """What a step reads: a hundred seconds of n days."""

    fresh: Any  # (n,) bool, days that begin: their state does
    r: Any  # (200, 7, n) residuals
    truth: Any  # (200, 12, n) bool: no fault, and the channels
    weight: Any  # (200, n) of a packet; mean 1, but for the rarest


def weights(onset, first) -> tuple[np.ndarray, np.ndarray]:
    """Weights (1800,) of a healthy and of a faulty packet by its number in the reading: the days of a number weigh alike in sum.

    onset, first: (n,) packets of the onset and of the start of the reading.
    """
    k = np.arange(leo4_days.PACKETS)[:, None]
    there, on = k + first < leo4_days.PACKETS, k >= onset - first
    counts = np.sum(there & ~on, 1), np.sum(there & on & (k < onset - first + JUDGED), 1)
    scale = 0.5 * np.sum(np.add(*counts)) / leo4_days.PACKETS
    return tuple(np.minimum(scale / np.maximum(count, 1), HEAVIEST) for count in counts)


def stretches(days: Days, plan: Plan, rng):
    """The stretches of a round. The days side by side are at different hours; where one has ended another begins.

    At the start of a round a place waits, without weight, until its hour is the first. What lies behind a day's end, of one
    that is not read from its first packet, is its last packet without weight.
    """
    n = len(days.onset)
    order = np.concatenate([rng.permutation(n) for _ in range(plan.passes + 1)])
    first = rng.integers(0, SKIPPED + 1, n)
    calm, faulty = weights(days.onset, first)
    places, at = np.arange(plan.batch), np.zeros(plan.batch, int)
    taken, begun = 0, np.zeros(plan.batch, bool)
    for k in range(plan.steps):
        part = (k + places) % PARTS
        fresh = part == 0
        at[fresh] = order[taken : taken + fresh.sum()]
        taken, begun = taken + fresh.sum(), begun | fresh
        number = LENGTH * part + np.arange(LENGTH)[:, None]
        packet, onset = first[at] + number, days.onset[at]
        on = packet >= onset
        truth = np.concatenate([~on[:, None], on[:, None] & days.channels[at].T], axis=1)
        weight = (
            begun
            * (packet < leo4_days.PACKETS)
            * np.where(on, faulty[number] * (packet < onset + JUDGED), calm[number])
        )
        r = np.ascontiguousarray(np.moveaxis(days.r[at, np.minimum(packet, leo4_days.PACKETS - 1)], -1, 1))
        yield Stretch(fresh, r, truth, weight.astype(np.float32))


def start(key, whiten) -> tuple[Gru, np.ndarray]:
    """Numbers before the training, and the scale (32,) by which the layer behind the state reads it.

    The update gates are such that the units are leaky means with memories from 2 to 80 packets; the scale makes their
    deviations in white noise about 1, whatever the memory.
    """
    key = jax.random.split(key, 4)
    normal = lambda i, *shape: np.asarray(jax.random.normal(key[i], shape, jnp.float32))
    memory = np.geomspace(QUICKEST, SLOWEST, UNITS)
    inputs = normal(0, 3 * UNITS, 14) * np.repeat([0.02, 0.02, 0.3 / np.sqrt(14)], UNITS)[:, None]
    recur = normal(1, 3 * UNITS, UNITS) * np.repeat([0.02, 0.02, 0.1 / np.sqrt(UNITS)], UNITS)[:, None]
    offset = np.concatenate([-np.log(memory - 1), np.zeros(2 * UNITS)])
    hidden, out = normal(2, HIDDEN, UNITS) / np.sqrt(UNITS), 0.3 * normal(3, CLASSES, HIDDEN) / np.sqrt(HIDDEN)
    scale = np.sqrt(2 * memory - 1) / 0.3
    made = Gru(whiten, inputs, recur, offset, hidden, np.zeros(HIDDEN), out, np.zeros(CLASSES))
    return Gru(*(np.asarray(a, np.float32) for a in made)), scale.astype(np.float32)


def loss(params: Gru, scale, h, told: Stretch):
    """-ln p(truth) by the weights of the packets, their mean, and the state (32, n) at the end.

    The days come last, so that a product is one for all of them; a packet is one step of the scan from residuals to loss,
    for a CPU then leaves nothing between them in memory.
    """

    def one(h, r, truth):
        seen = jax.lax.stop_gradient(gru.features(params, r, jnp.matmul))
        h = gru.advanced(params, h, params.inputs @ seen + params.offset, jnp.matmul)
        return h, _surprise(gru.logits(params, scale * h, jnp.matmul), truth)

    def packet(state, told):
        h, total = state
        r, truth, weight = told
        h, lost = jax.vmap(one, in_axes=-1, out_axes=-1)(h, r, truth)
        return (h, total + jnp.mean(weight * lost)), None

    h = jnp.where(told.fresh, 0, h)
    (h, total), _ = jax.lax.scan(packet, (h, jnp.zeros((), h.dtype)), told[1:])
    return total / len(told.r), h


def _surprise(found, truth):
    """-ln of the probability given to what is true, one class or more, by logits; 69 at most."""
    weights = jnp.exp(found - jax.lax.stop_gradient(jnp.max(found)))  # one exponential for both sums
    return jnp.log(jnp.sum(weights)) - jnp.log(jnp.sum(jnp.where(truth, weights, 0)) + 1e-30)


def _step(plan: Plan, trained, scale, h, told: Stretch):
    """A step of Adam: numbers and the optimiser's state, the states of the days, and the loss before it."""
    params, state = trained
    (value, h), slope = jax.value_and_grad(loss, has_aux=True)(params, scale, h, told)
    updates, state = _optimizer(plan).update(slope._replace(whiten=0 * slope.whiten), state)
    return (optax.apply_updates(params, updates), state), h, value


def _optimizer(plan: Plan) -> optax.GradientTransformation:
    total = plan.rounds * plan.steps
    rate = optax.warmup_cosine_decay_schedule(0.0, plan.rate, min(100, total // 4), total)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))


def train(key, plan: Plan = SHIPPED, *, save: str | Path | None = None, progress: bool | None = None) -> Trained:
    """Train the unit.

    Args:
        key: of days, noise, order and start; the shipped numbers have ``jax.random.key(0)``, the public one.
        plan: how much.
        save: file (.npz) that holds the training after each round, so that a killed one goes on where it was: with the
            same numbers. A file of another training is refused.
        progress: show a bar; None on a terminal or in a notebook.

    Returns:
        `Trained`; the same bits on the same machine and JAX.

    Raises:
        ValueError: a plan of less than a round, a day, a pass or a step; a file of another training.

    Example:
        >>> found = train(jax.random.key(0), Plan(rounds=2, days=256), save="gru_training.npz")
    """
    for name in ("rounds", "days", "passes", "batch"):
        check.whole(f"plan.{name}", getattr(plan, name))
    if not plan.steps:
        check.refuse("plan.batch", f"be at most {PARTS * plan.passes * plan.days}, or no step is made", plan.batch)
    data = one_key(key)
    key = jax.random.wrap_key_data(jnp.asarray(data))
    params, scale = start(key, recording.whitening(recording.public()))
    at, history = (params, _optimizer(plan).init(params)), []
    step = jitted(partial(_step, plan))
    none = np.zeros((UNITS, plan.batch), np.float32)
    sizes = (((), bool), ((LENGTH, 7), np.float32), ((LENGTH, CLASSES), bool), ((LENGTH,), np.float32))
    shapes = Stretch(*(jax.ShapeDtypeStruct((*size, plan.batch), kind) for size, kind in sizes))
    path = None if save is None else check.place("save", save)
    if path is not None:
        mark = mark_of([step.lower(at, scale, none, shapes)], (data, at, scale, tuple(plan)))
        at, history = _resumed(path, mark, at)
    total = plan.rounds * plan.steps
    with progress_bar(progress, total, " steps", plan.steps * len(history)) as bar:
        for k in range(len(history), plan.rounds):
            days, h, losses = drawn(jax.random.fold_in(key, k), plan.days), none, []
            for told in stretches(days, plan, np.random.default_rng([*map(int, data), k])):
                at, h, value = step(at, scale, h, told)
                losses.append(value)
                bar.update()
            history.append(np.mean(jax.device_get(losses)))
            bar.set_postfix(loss=f"{history[-1]:.4f}", refresh=False)
            if path is not None:
                leaves = {f"leaf{i}": leaf for i, leaf in enumerate(jax.tree.leaves(jax.device_get(at)))}
                replaced(path, dict(mark=np.array(mark), history=np.array(history), **leaves))
    found = jax.device_get(at[0])
    return Trained(found._replace(hidden=found.hidden * scale), np.array(history))


def _resumed(path: Path, mark: str, at):
    """What the file holds of this training; as given where there is no file."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        return at, []
    try:
        with np.load(path, allow_pickle=False) as held:
            same = str(held["mark"]) == mark
            leaves = [held[f"leaf{i}"] for i in range(len(jax.tree.leaves(at)))]
            history = list(held["history"])
    except Exception:  # whatever NumPy says of another or a broken file
        same = False
    if not same:
        check.refuse("save", "hold a training of the same key, plan, program and JAX", f"`{path}`")
    return jax.tree.unflatten(jax.tree.structure(at), leaves), history
