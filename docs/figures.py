"""The site's figures: ``python docs/figures.py RESULTS`` after ``python -m experiments --quick --out RESULTS``.

Takes the figures that the pages name from the results, draws the overview, and stores all as palette PNGs, a third
of the size, and a movie of one run as a GIF. Then it runs `benchmarks.check_cases` and puts its tables on the page `trust.md`.
"""

import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import matplotlib
import numpy as np
from PIL import Image

import jaxatt
from jaxatt import view
from jaxatt.loops import observer_pd as loop
from jaxatt.plot import COLOURS

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
TICKS, CELLS, SEEDS = 900, 64, 25


def overview():
    """One run with its alarm, and a hundred thousand: how long a biased gyro is seen, by bias and threshold."""
    healthy = jaxatt.on_axes(jaxatt.Fault())
    bias = jaxatt.Fault(onset=30.0, bias=0.03)
    scenario = loop.scenario._replace(star=healthy, gyro=healthy._replace(x=bias))
    log = jaxatt.simulate(loop.system, loop.params, scenario, jax.random.key(0), ticks=TICKS)

    sizes, sigmas = np.geomspace(0.002, 0.3, CELLS), np.geomspace(0.001, 0.1, CELLS)
    size, sigma, _ = (a.ravel() for a in np.meshgrid(sizes, sigmas, np.arange(SEEDS)))

    def pair(size, sigma):
        gyro = healthy._replace(x=bias._replace(bias=size))
        return loop.params._replace(sigma=sigma), scenario._replace(gyro=gyro)

    pairs = jax.vmap(pair)(np.float32(size), np.float32(sigma))

    started = time.perf_counter()
    scores = jaxatt.sweep(
        jaxatt.varied(loop.system), (), pairs, jax.random.key(1), ticks=TICKS, score=jaxatt.varied(loop.score)
    )
    took = time.perf_counter() - started
    seen, false = ((a.reshape(CELLS, CELLS, SEEDS)).mean(-1) for a in (1 - scores.miss, scores.false_alarms))
    print(f"{size.size} runs of {TICKS * loop.DT:.0f} s took {took:.0f} s, compilation included")

    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    t = loop.DT * np.arange(TICKS)
    left.semilogy(t, log.xi, color=COLOURS[0], linewidth=0.8, label="residual norm")
    left.axhline(loop.params.sigma, color=COLOURS[1], linestyle="--", label="threshold")
    left.axvline(30, color="0.3", linestyle=":", label="gyro bias of 0.03 rad/s")
    left.set(xlabel="time [s]", ylabel="residual norm [MRP, rad/s]", title="One run")
    left.legend(loc="upper right", fontsize="small")
    image = right.pcolormesh(sizes, sigmas, seen, cmap="cividis", vmin=0, vmax=1, shading="nearest", rasterized=True)
    one_percent = float(np.exp(np.interp(-0.01, -false.mean(1), np.log(sigmas))))  # it falls with the threshold
    right.axhline(one_percent, color="w", linewidth=3)
    right.axhline(one_percent, color="k", linewidth=1.2, linestyle="--", label="1 % false alarms in healthy time")
    right.plot([0.03], [loop.params.sigma], "o", color="w", markeredgecolor="k", label="the run at the left")
    right.set(xscale="log", yscale="log", xlabel="gyro bias [rad/s]", ylabel="detection threshold [MRP, rad/s]")
    right.set_title(f"{size.size:,} runs".replace(",", " "))
    right.legend(loc="upper left", fontsize="small")
    fig.colorbar(image, ax=right, label="share of faulty time with alarm [1]")
    fig.savefig(HERE / "figures" / "overview.png", dpi=130)


def tumble():
    """A body that tumbles at first, an estimate that starts wrong, and a gyro that fails at 20 s, as a GIF of few colours."""
    healthy = jaxatt.on_axes(jaxatt.Fault())
    scenario = loop.scenario._replace(
        w=jaxatt.Vec3(-0.2, 0.1, 0.2), q_hat=jaxatt.Vec3(0.0, 0.4, -0.3), w_hat=jaxatt.Vec3(0.0, 0.0, 0.0), star=healthy,
        gyro=healthy._replace(x=jaxatt.Fault(onset=20.0, bias=0.5)),
    )  # fmt: skip
    log = jaxatt.simulate(loop.system, loop.params, scenario, jax.random.key(0), ticks=280)
    sun = {"Sun": jaxatt.Vec3(1.0, -0.5, 0.7)}
    path = view.movie(log, HERE / "figures" / "tumble.gif", directions=sun, size=(1.0, 1.0, 1.6), frames=44, pixels=280)
    with Image.open(path) as movie:
        pictures = []
        for i in range(movie.n_frames):
            movie.seek(i)
            pictures.append(movie.convert("RGB"))
    palette = pictures[-1].quantize(36, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=100, loop=0, optimize=False)


def shrunk(source: Path, target: Path) -> None:
    """Store as a palette PNG of at most 1400 pixels' width."""
    with Image.open(source) as image:
        image = image.convert("RGB")
        image.thumbnail((1400, 2800), Image.Resampling.LANCZOS)
        image.quantize(128, dither=Image.Dither.NONE).save(target, optimize=True)


def tables_of(found: dict) -> dict[str, str]:
    """The tables of `benchmarks.check_cases` in Markdown, by the name of their place on the page."""

    def table(head: str, rows) -> str:
        lines = [f"| {head} |", "|---" * (head.count("|") + 1) + "|", *(f"| {' | '.join(row)} |" for row in rows)]
        return "\n".join(lines)

    number = lambda row, name: f"{row[name]:.1e}" if name in row else "-"
    cases = [
        [r["case"], r["reference"], *(number(r, k) for k in ("attitude", "rate", "position")), r["tools"]]
        for r in found["cases"]
    ]
    tools = [[r["tool"], r["how"], number(r, "rate"), number(r, "attitude"), r["remark"]] for r in found["tools"]]
    laws = [[r["law"], f"{r['value']:.4g}", f"{r['low']:g} to {r['high']:g}"] for r in found["laws"]]
    return {
        "cases": table(
            "case, at | reference | attitude [deg] | rate [rad/s] | position [m] | tools that agree to that", cases
        ),
        "tools": table("tool | how | rate [deg/s] | attitude [deg] | remark", tools),
        "laws": table("law | value | allowed", laws),
    }


def check_cases() -> None:
    """Run the check cases and put their tables between the marks of the page."""
    page = HERE / "trust.md"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "cases.json"
        subprocess.run(
            [sys.executable, "-m", "benchmarks.check_cases", "--json", str(out)], cwd=HERE.parent, check=True
        )
        tables = tables_of(json.loads(out.read_text()))
    text = page.read_text()
    for name, table in tables.items():
        text = re.sub(
            rf"(<!-- {name} -->\n).*?(<!-- end -->)", lambda m, t=table: f"{m[1]}\n{t}\n\n{m[2]}", text, flags=re.S
        )
    page.write_text(text)


if __name__ == "__main__":
    check_cases()
    jaxatt.configure()
    overview()
    tumble()
    shrunk(HERE / "figures" / "overview.png", HERE / "figures" / "overview.png")
    pages = [*HERE.glob("loops/*.md"), HERE / "guides" / "rare_events.md"]
    named = {name for page in pages for name in re.findall(r"figures/(\w+)\.png", page.read_text())}
    for name in sorted(named):
        (system,) = [p.name for p in Path(sys.argv[1]).iterdir() if p.is_dir() and name.startswith(p.name)]
        shrunk(Path(sys.argv[1]) / system / f"{name.removeprefix(system + '_')}.png", HERE / "figures" / f"{name}.png")
