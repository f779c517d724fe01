"""What each measure of energy is, in words that stand beside its number."""

from __future__ import annotations

from app.analysis.energy.measures import Measure

SHARES = {Measure.AMPLITUDE, Measure.SQUARE, Measure.ALL_SIDES}
"""Measures that are shares of what cDBS takes: pages show them in % of cDBS, files and the API as they are."""

MEASURES: dict[Measure, tuple[str, str, str]] = {
    Measure.AMPLITUDE: (
        "Mean amplitude", "share of cDBS", "Mean over the session's steps of a, the share of the cDBS amplitude, on the controlled side.",
    ),
    Measure.SQUARE: (
        "Mean squared amplitude", "share of cDBS",
        "Mean over the session's steps of a² on the controlled side: its energy at the pulse width and rate of cDBS. Every page that "
        "speaks of energy uses this.",
    ),
    Measure.ALL_SIDES: (
        "Energy of all sides and programs", "share of cDBS",
        "Sum over sides and programs of mean I² · w · f, over the same sum at their cDBS amplitudes; width w and rate f as recorded. "
        "With one side and program the mean of a².",
    ),
    Measure.CHARGE: (
        "Charge", "µC/s", "Sum over sides and programs of mean I · w · f, with width w and rate f as recorded; only where all are known.",
    ),
    Measure.TEED: (
        "Total electrical energy delivered", "µW",
        "Sum over sides and programs of mean I² · R · w · f (Koss et al. 2005, for currents), with the impedance R that you stated "
        "for all contacts: no recording here names that of the contacts in use.",
    ),
}  # fmt: skip
"""Title, unit and definition."""
