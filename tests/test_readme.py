"""The README's code runs as printed, and what it names exists."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_first_steps_run_as_printed():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    quick = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # as for tests marked short
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=quick, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, after = map(int, re.findall(r"after: (\d+) (\d+)", done.stdout)[0])
    assert before == 0 and after > 250
    first, best = map(float, re.findall(r"cost (\S+) -> (\S+)", done.stdout)[0])
    assert best < first


def test_files_and_links_that_it_names_exist():
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README) + re.findall(r"`((?:notebooks|jaxatt)/[\w/.]+)`", README):
        assert (ROOT / path).exists(), path
    for name in re.findall(r"`jaxatt\.loops\.(\w+)`", README):
        assert (ROOT / "jaxatt" / "loops" / f"{name}.py").exists(), name
