"""Train the learned row by gradient: days of leo4 with faults of the public catalogue, key and sizes public, no test day.

Each round simulates days afresh, each with a fault of a kind and a public size drawn evenly, and cuts windows of a
hundred seconds from them, half of them before the onset. The loss is the mean of -ln of the probability given to what is true at
each packet: no fault, or one of the faulty channels.

May import: gru, recording, worlds, leo4, check, compiling, noise, resuming, sweeping.
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
from jaxatt.yardstick import gru, recording, worlds
from jaxatt.yardstick.gru import CLASSES, HIDDEN, UNITS, Gru
from jaxatt.yardstick.leo4 import PACKET
from jaxatt.yardstick.worlds import SIZED

LENGTH, UNJUDGED = 200, 40  # [packets] of a window, and of its start, in which the state still fills
LEAST, MOST = 80, 140  # [packets] from the start of a faulty window to the onset
QUICKEST, SLOWEST = 2.0, 80.0  # [packets] memories of the units at the start of the training


class Plan(NamedTuple):
    """How much is trained: ``rounds`` of so many days, each met ``passes`` times, ``batch`` days a step."""

    rounds: int = 5
    days: int = 4096
    passes: int = 8
    batch: int = 128
    rate: float = 4e-3  # of Adam, after a rise over 100 steps, or a quarter of all; falls to 0 by a cosine

    @property
    def steps(self) -> int:
        """Of a round."""
        return self.passes * (self.days // self.batch)


SHIPPED = Plan()  # of the numbers in the package


class Trained(NamedTuple):
    """What a training gives."""

    params: Gru
    loss: Any  # (rounds,) mean of each round [nat a packet]


class Days(NamedTuple):
    """Days to learn from."""

    r: Any  # (n, 1800, 7) residuals
    onset: Any  # (n,) number of the first packet that the fault has touched
    channels: Any  # (n, 11) bool


def drawn(key, n: int) -> Days:
    """n days with a fault: kinds evenly, and the public sizes of each."""
    cells = [(kind, size) for kind, sizes in SIZED.items() for size in sizes]
    table = jax.tree.map(lambda *a: np.array(a, np.float32), *(worlds.effects(cell) for cell in cells))
    at = np.asarray(jax.random.randint(jax.random.fold_in(key, 1), (n,), 0, len(cells), jnp.int32))
    days = worlds.days(worlds.WORLDS["leo4"], key, np.arange(n), jax.tree.map(lambda a: a[at], table))
    onset = np.floor((worlds.onset_of(days) + worlds.WARMUP) / PACKET).astype(int)
    return Days(recording.residuals_of(days, key), onset, worlds.true_channels(days))


def windows(days: Days, at, rng) -> tuple[np.ndarray, np.ndarray]:
    """A faulty window of each of the days ``at``, and one before the onset: residuals (200, 7, 2 n), truth (200, 12, 2 n)."""
    onset, n = days.onset[at], len(at)
    faulty = np.minimum(onset - rng.integers(LEAST, MOST, n), worlds.PACKETS - LENGTH)
    calm = UNJUDGED + np.floor(rng.random(n) * (onset - LENGTH - UNJUDGED)).astype(int)
    rows = np.concatenate([faulty, calm]) + np.arange(LENGTH)[:, None]
    which = np.concatenate([at, at])
    on = (rows >= np.concatenate([onset, onset]))[:, None]
    truth = np.concatenate([~on, on & days.channels[which].T], axis=1)
    return np.ascontiguousarray(np.moveaxis(days.r[which, rows], -1, 1)), truth


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


def loss(params: Gru, scale, r, truth):
    """Mean of -ln p(truth) over the judged packets of windows: r (200, 7, n), truth (200, 12, n) bool.

    The windows come last, so that a product is one for all of them; a packet is one step of the scan from residuals to loss,
    for a CPU then leaves nothing between them in memory.
    """

    def one(h, r, truth):
        seen = jax.lax.stop_gradient(gru.features(params, r, jnp.matmul))
        h = gru.advanced(params, h, params.inputs @ seen + params.offset, jnp.matmul)
        return h, _surprise(gru.logits(params, scale * h, jnp.matmul), truth)

    def packet(state, told):
        h, total = state
        r, truth, judged = told
        h, lost = jax.vmap(one, in_axes=-1, out_axes=-1)(h, r, truth)
        return (h, total + judged * jnp.mean(lost)), None

    kind = jnp.result_type(r)
    judged = np.where(np.arange(len(r)) < UNJUDGED, 0, 1 / (len(r) - UNJUDGED)).astype(kind)
    nothing = jnp.zeros((UNITS, r.shape[-1]), kind), jnp.zeros((), kind)
    return jax.lax.scan(packet, nothing, (r, truth, judged))[0][1]


def _surprise(found, truth):
    """-ln of the probability given to what is true, one class or more, by logits; 69 at most."""
    weights = jnp.exp(found - jax.lax.stop_gradient(jnp.max(found)))  # one exponential for both sums
    return jnp.log(jnp.sum(weights)) - jnp.log(jnp.sum(jnp.where(truth, weights, 0)) + 1e-30)


def _step(plan: Plan, trained, scale, r, truth):
    """A step of Adam: numbers and the optimiser's state, and the loss before it."""
    params, state = trained
    value, slope = jax.value_and_grad(loss)(params, scale, r, truth)
    updates, state = _optimizer(plan).update(slope._replace(whiten=0 * slope.whiten), state)
    return (optax.apply_updates(params, updates), state), value


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
        ValueError: a plan of less than a round, a day or a pass, or whose batch does not divide its days; a file of
            another training.

    Example:
        >>> found = train(jax.random.key(0), Plan(rounds=2, days=256), save="gru_training.npz")
    """
    for name in ("rounds", "days", "passes", "batch"):
        check.whole(f"plan.{name}", getattr(plan, name))
    if plan.days % plan.batch:
        check.refuse("plan.days", f"be a multiple of plan.batch, {plan.batch}", plan.days)
    data = one_key(key)
    key = jax.random.wrap_key_data(jnp.asarray(data))
    params, scale = start(key, recording.whitening(recording.public()))
    at, history = (params, _optimizer(plan).init(params)), []
    step = jitted(partial(_step, plan))
    shapes = [jax.ShapeDtypeStruct((LENGTH, n, 2 * plan.batch), kind) for n, kind in ((7, np.float32), (12, bool))]
    path = None if save is None else check.place("save", save)
    if path is not None:
        mark = mark_of([step.lower(at, scale, *shapes)], (data, at, scale, tuple(plan)))
        at, history = _resumed(path, mark, at)
    total = plan.rounds * plan.steps
    with progress_bar(progress, total, " steps", plan.steps * len(history)) as bar:
        for k in range(len(history), plan.rounds):
            days, losses = drawn(jax.random.fold_in(key, k), plan.days), []
            rng = np.random.default_rng([*map(int, data), k])
            for _ in range(plan.passes):
                for batch in rng.permutation(plan.days).reshape(-1, plan.batch):
                    at, value = step(at, scale, *windows(days, batch, rng))
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
