"""Campaigns: a sweep on disk, in blocks that can be killed, resumed, shared out, extended and rerun.

A campaign is a pure function of the index of a scenario, so it matters neither who computes a block nor when. The store
is a Zarr group of labelled arrays in chunks of one block (`store`); it holds numbers and names, no code: opening one
runs nothing. `designs` spreads the scenarios, `summary` says what they show; both work without Zarr. The rest needs the
extra ``campaign``: pip install 'jaxatt[campaign]'.

Its modules may import: campaign, check, fields, contract, compiling, noise, engine, sweeping.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxatt.campaign.draw import Campaign, sampling_key, scenarios
    from jaxatt.campaign.read import dataset, rerun
    from jaxatt.campaign.workers import extend, run, until

__all__ = ["Campaign", "dataset", "extend", "rerun", "run", "sampling_key", "scenarios", "until"]

_HOMES = {
    "draw": ("Campaign", "sampling_key", "scenarios"),
    "read": ("dataset", "rerun"),
    "workers": ("extend", "run", "until"),
}
_MODULES = ("designs", "draw", "provenance", "read", "store", "summary", "workers")


def __getattr__(name: str):
    """A module or a public name, loaded when it is first asked for."""
    home = next((module for module, names in _HOMES.items() if name in names), name)
    if home not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{home}")
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("xarray", "zarr"):
            raise
        raise ImportError(
            f"jaxatt.campaign needs the extra `campaign`: pip install 'jaxatt[campaign]' ({error})."
        ) from None
    return module if home == name else getattr(module, name)


def __dir__():
    return sorted([*__all__, *_MODULES])
