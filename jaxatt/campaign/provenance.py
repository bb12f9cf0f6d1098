"""What a store says of where its numbers come from: the inputs of the campaign by name, and the machine.

A campaign goes on only where all of it is the same; the message says what differs. Functions of installed packages are
compared by their names, those of a user by what they are: their code, what they capture, and the functions and numbers
that they use. So a script may be renamed, or run and then imported.

May import: check, fields, noise, store, draw.
"""

from __future__ import annotations

import dis
import os
import platform
import re
import subprocess
import sys
import sysconfig
import zlib
from collections.abc import Collection, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
import zarr

from jaxatt import check, noise
from jaxatt.campaign.draw import Campaign
from jaxatt.fields import named


def manifest_of(campaign: Campaign, n: int) -> dict:
    """The inputs of a campaign of n scenarios as plain values, by name.

    All but ``n`` and ``history`` must be the same to resume.
    """
    functions = {field: _name(getattr(campaign, field)) for field in ("sample", "score", "inputs", "record")}
    loop = {f"system.{field}": _name(value) for field, value in campaign.system._asdict().items()}
    return {
        "format": 2,
        "noise": noise.VERSION,
        "n": n,
        "key": campaign.key.tolist(),
        **{field: getattr(campaign, field) for field in ("ticks", "every", "block", "size")},
        **loop,
        **functions,
        **{f"params.{name}": _plain(leaf) for name, leaf in named(campaign.params, "params").items()},
        **environment(),
        "history": _history(),
    }


def refuse_other(path: Path, stored: Mapping, now: Mapping, accept: Collection[str] = ()) -> None:
    """Refuse a campaign whose manifest ``now`` is not the stored one; accept: names that may differ.

    path: of the store. The ValueError says what differs.
    """
    names = [k for k in {**stored, **now} if k not in ("n", "history", *accept)]
    differ = [k for k in names if stored.get(k) != now.get(k)]
    if differ:
        each = "; ".join(f"{k} is {now.get(k)!r}, but {stored.get(k)!r} in the store" for k in differ)
        raise ValueError(f"`campaign` must be the one that began {path.name}, but these differ: {each}.")


def names_of(accept) -> tuple[str, ...]:
    """``accept`` as names in the manifest; TypeError for what holds no names."""
    if isinstance(accept, str) or not all(isinstance(name, str) for name in (accept if np.iterable(accept) else [0])):
        raise TypeError(f"`accept` must be names in the manifest, but it is {check.short(accept)}.")
    return tuple(accept)


def environment() -> dict:
    """What the bits of a result depend on, beside the campaign."""
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "host_platform_device_count" not in f]
    return {
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "backend": jax.default_backend(),
        "device": jax.devices()[0].device_kind,
        "machine": platform.machine(),
        "x64": bool(jax.config.read("jax_enable_x64")),
        "XLA_FLAGS": " ".join(sorted(flags)),
    }


def _history() -> dict:
    """What is worth knowing later and decides nothing."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        git = ""
    versions = {"numpy": np.__version__, "zarr": zarr.__version__, "xarray": xr.__version__}
    return {"python": platform.python_version(), **versions, "git": git or "none"}


def _name(thing, seen: tuple = ()) -> str:
    """A function of a package by module and name, one of a user by name and code, a value by what it prints.

    seen: the functions on the way to this one, for they may call each other.
    """
    name = lambda a: _name(a, seen)
    if isinstance(thing, partial):
        words = [name(a) for a in thing.args] + [f"{k}={name(v)}" for k, v in sorted(thing.keywords.items())]
        return f"{name(thing.func)}({', '.join(words)})"
    if isinstance(thing, (np.ndarray, np.generic, jax.Array)):
        return str(_plain(jax.random.key_data(jnp.asarray(thing)) if check.is_key(thing) else thing))
    if isinstance(thing, Mapping):
        return f"{{{', '.join(f'{name(k)}: {name(v)}' for k, v in thing.items())}}}"
    if isinstance(thing, (tuple, list)):
        return f"({', '.join(map(name, thing))})"
    if isinstance(thing, (set, frozenset)):
        return f"{{{', '.join(sorted(map(name, thing)))}}}"
    if isinstance(thing, ModuleType):
        return thing.__name__ if _packaged(thing.__name__) else "a module"
    plain = thing if isinstance(thing, FunctionType) else getattr(thing, "__wrapped__", thing)  # within jit
    if hasattr(plain, "__qualname__") and hasattr(plain, "__module__"):
        if _packaged(plain.__module__ or "builtins"):
            return f"{plain.__module__}.{plain.__qualname__}"
        if isinstance(plain, FunctionType) and plain not in seen:
            crc = zlib.crc32(_meaning(plain, (*seen, plain)).encode())
            return f"{plain.__qualname__} (code of Python {'.'.join(map(str, sys.version_info[:2]))}, crc32 {crc:08x})"
        return plain.__qualname__
    return re.sub(r" at 0x[0-9a-f]+", "", repr(thing))


_PACKAGES = tuple(str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "purelib", "platlib"))


def _packaged(module: str) -> bool:
    """Whether a module is ours, comes with Python or is installed, rather than written by the user."""
    if module == "__main__" or module not in sys.modules:
        return False
    file = getattr(sys.modules[module], "__file__", None)
    ours = module.split(".")[0] == __name__.split(".")[0]
    return ours or file is None or str(Path(file).resolve()).startswith(_PACKAGES)


def _meaning(function: FunctionType, seen: tuple) -> str:
    """What decides the numbers of a function: code, defaults, captured values, and what it uses of its own module."""
    captured = []
    for cell in function.__closure__ or ():
        try:
            captured.append(cell.cell_contents)
        except ValueError:  # not yet set
            captured.append("nothing yet")
    used = {name: function.__globals__[name] for name in _globals(function.__code__) if name in function.__globals__}
    parts = function.__defaults__, function.__kwdefaults__, captured, used
    return f"{_code(function.__code__)} {_name(parts, seen)}"


def _globals(code: CodeType) -> list[str]:
    """Names of the globals that a code reads, also within the functions that it makes."""
    names = {i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return sorted(names.union(*(_globals(part) for part in code.co_consts if isinstance(part, CodeType))))


def _code(code: CodeType) -> str:
    """The code without where it stands: no file, no line."""
    constants = [_code(part) if isinstance(part, CodeType) else _name(part) for part in code.co_consts]
    return f"{code.co_code.hex()} {constants} {code.co_names} {code.co_varnames} {code.co_freevars}"


def _plain(leaf):
    """A leaf for JSON: its numbers, or the checksum of many."""
    a = np.asarray(leaf)
    if a.size > 32:
        return f"{a.dtype} of shape {a.shape}, crc32 {zlib.crc32(a.tobytes()):08x}"
    numbers = a.tolist() if a.dtype.kind != "f" else np.vectorize(_number, otypes=[object])(a).tolist()
    return numbers if a.dtype != np.float32 else {"float32": numbers}


def _number(x: float):
    return float(x) if np.isfinite(x) else str(float(x))  # JSON has no infinity
