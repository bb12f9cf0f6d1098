"""Abuse of the yardstick's verbs, of days that are made up: what runs them is replaced, what meets the user is not."""

from unittest.mock import patch

import jax
import numpy as np
from abuse import arrays, fuzzed, good, judged, junk, nearly, odd, plain, tidy, whole
from hypothesis import given
from hypothesis import strategies as st
from test_yardstick import MINE, WORLD, made_up

from jaxatt.yardstick import WORLDS, Verdict, calibrate, calibration, rank, ranking, rules
from jaxatt.yardstick.harness import Softly

PASSED = rules.Checks(True, True, True, True, True, 10.0)
OTHER = MINE._replace(name="other")


def crooked(params, z, telemetry):
    return z, Verdict(telemetry.innovation, np.ones(3))


def half_nan(*args, **kwargs):
    """Made-up days of which every other one has no number for a score."""
    found = made_up(*args, **kwargs)
    return found._replace(peak=np.where(np.arange(len(found.peak))[:, None] % 4 < 2, found.peak, np.nan), unclear=found.unclear + 0.5)  # fmt: skip


def softly(world, rows, key, days, numbers, params_of, **_):
    peak = made_up(world, rows, key, days).peak
    return Softly(peak, peak), Softly(np.repeat(peak[..., None], len(numbers) + 2, -1), None)


def asked(verb, runner, **arguments):
    with (
        patch.object(calibration, "run", runner), patch.object(ranking, "run", runner),
        patch.object(calibration, "slopes", softly), patch.object(rules, "checked", lambda *_: PASSED),
    ):  # fmt: skip
        return verb(**arguments)


detectors = st.one_of(
    st.sampled_from([[MINE, OTHER], (MINE, OTHER), [MINE, MINE], [], MINE, [MINE, 3], [OTHER, MINE._replace(step=crooked)]]), junk
)  # fmt: skip
runner = st.sampled_from([made_up, made_up, half_nan])
hours = st.one_of(st.just(100.0), good(100, 300), plain(), odd, junk)
keys = st.sampled_from([jax.random.key(0), jax.random.PRNGKey(1), jax.random.split(jax.random.key(0)), jax.random.key(0, impl="rbg"), 7, None, "key"])  # fmt: skip
worlds = st.one_of(st.just(WORLD), st.just(WORLDS["microsat"]), junk)
sizes = st.one_of(good(0.1, 5), odd, junk, st.just((1.0, 2.0)), arrays())
cells = st.lists(st.one_of(st.tuples(st.sampled_from(["gyro_bias", "star_bias", "wheel_loss", "gyro_bias+wheel_offset", "none", 3, None]), sizes), st.none(), junk), max_size=3)  # fmt: skip
gradients = st.one_of(
    st.tuples(plain(), st.sampled_from([lambda x: (x[0], x[0]), lambda x: x[0], lambda x: (x[0],), None])), st.none(), junk
)  # fmt: skip


def test_calibrate():
    right = dict(world=WORLD, detectors=[MINE, OTHER], key=jax.random.key(0), hours=100.0, rate=0.1, gradient=None)
    wild = dict(world=worlds, detectors=detectors, key=keys, hours=hours, rate=st.one_of(good(0.01, 5), plain()), gradient=gradients)  # fmt: skip

    @fuzzed
    @given(runner, nearly(right, wild))
    def run(runner, arguments):
        judged(asked, {*right, "step", "mine"}, calibrate, runner, **arguments)

    run()
    tidy()


def test_rank():
    right = dict(
        detectors=[MINE, OTHER], world=WORLD, ruleset="nominal", days=4, key=jax.random.key(0), hours=100.0,
        cells=[("gyro_bias", 3.06)],
    )  # fmt: skip
    wild = dict(
        detectors=detectors, world=worlds, ruleset=st.one_of(st.sampled_from(["nominal", "open", "none"]), junk),
        days=st.one_of(st.just(5), whole), key=keys, hours=hours, cells=st.one_of(cells, junk.filter(lambda a: a is not None)),
    )  # fmt: skip

    @fuzzed
    @given(runner, nearly(right, wild))
    def run(runner, arguments):
        judged(asked, {*right, "cell", "step", "mine"}, rank, runner, **arguments)

    run()
    tidy()
