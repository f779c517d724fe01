"""Libraries that estimators and learners load at their first use, loaded at once: for a process whose forks are to find them there.

A fresh process that trains or estimates spends some ten seconds of processor time before it computes anything, nearly all of it on these.
"""

from __future__ import annotations

from importlib import import_module

LAZY = (
    "numba.core.dispatcher",
    "pyarrow.parquet",
    "scipy.integrate",
    "scipy.interpolate",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.sparse",
    "scipy.special",
    "scipy.stats",
)
"""Modules that are reached through their packages, which import them where they are used."""


def load_libraries() -> None:
    """Import what estimators and learners use. No gradient is taken and no thread started, so that the process may be forked afterwards."""
    import torch  # only here: who names this module may yet train nothing

    for name in LAZY:
        import_module(name)
    weight = torch.zeros(1, requires_grad=True)
    weight.grad = torch.zeros(1)
    torch.optim.Adam([weight]).step()  # the first step of any optimiser imports torch's compiler, used or not
