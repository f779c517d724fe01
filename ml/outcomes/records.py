"""Records of outcomes: range, direction, margin, failure, part in r_end, and words. Source: Gao et al. 2023, section 3."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Margin:
    """By how much an outcome may be worse than under cDBS and still count as no worse.

    Attributes:
        field: its name in tables, forms and the interface. kind: a share of the value under cDBS, or points of the outcome's scale.
        default: ours, no clinical standard. least, most: bounds of the form. unit: of the margin, for the bounds' message.
        label, help, form_unit: of the form. description: of the interface and the data package.
    """

    field: str
    kind: Literal["share", "points"]
    default: float
    least: float
    most: float
    unit: str
    label: str
    help: str
    form_unit: str
    description: str

    def __post_init__(self) -> None:
        self.check(self.default)

    def check(self, value: float) -> None:
        """Raise ValueError for a margin that is not above 0, or a share of 1 or more."""
        if not value > 0 or (self.kind == "share" and not value < 1):
            raise ValueError(f"{self.field} must be above 0{', and below 1' if self.kind == 'share' else ''}, not {value}")

    def amount(self, value: float, under_cdbs: float) -> float:
        """Return the margin in the outcome's unit, for a margin of `value` and an outcome under cDBS."""
        return value * under_cdbs if self.kind == "share" else value


@dataclass(frozen=True, kw_only=True)
class EndWeight:
    """The part of an outcome in the end-of-session reward (eq:end_of_session_reward).

    Attributes:
        setting: the name of its weight in the settings. sign: 1, or -1 where more takes reward away.
        as_fraction: the setting that says that per cent enter as 0 to 1; None where the outcome enters as it is.
        label, help: of the form. description: of the interface.
    """

    setting: str
    sign: float
    label: str
    help: str
    description: str
    as_fraction: str | None = None

    def scale(self, settings: Any) -> float:
        """Return by what the outcome is divided before it is weighed."""
        return 100.0 if self.as_fraction is not None and getattr(settings, self.as_fraction) else 1.0

    def weight(self, settings: Any) -> float:
        """Return the signed weight of the outcome as it enters."""
        return self.sign * float(getattr(settings, self.setting))

    def per_unit(self, settings: Any) -> float:
        """Return what one unit of the outcome adds to the reward."""
        return self.weight(settings) / self.scale(settings)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """The facts that the outcome model of `ml.ope` and its posterior need of an outcome.

    Attributes:
        kind: the distribution: of a measured number, of a rounded rating, of minutes that have it or not (the unit is per cent then).
        model_error: standard deviation of what structures of the model get wrong near the data, and what is added where no session is
            near; of the value, or of the logit of minutes.
        least_error: smallest standard deviation of a session, which is what its measurement resolves.
    """

    kind: Literal["gaussian", "rounded", "binomial"]
    model_error: tuple[float, float]
    least_error: float

    @property
    def percent(self) -> float:
        """The unit of the outcome in shares: 100 of minutes, which the model takes as shares, else 1."""
        return 100.0 if self.kind == "binomial" else 1.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One outcome of a session: what it is called, how it is measured, judged, tested and shown.

    Attributes:
        key: its name in analyses. field: in tables, forms and the interface. column: in the data package.
        label: its whole name. short: the name in columns. noun: within a sentence. the_noun: as the subject of one.
        unit: of a value. entry_unit: the same next to a field and in columns. sentence_unit: the same within a sentence.
        difference_unit: of a change. difference_words: the same within a sentence. contrast_unit: of the primary comparison.
        help: what is measured. explained: the same for a glossary.
        worse: the word for a worse value. note: for a reader of a value within a sentence.
        description: of the interface. exported: of the data package.
        low, high: the range; an infinite `high` has no end. below: what a value stays below that may be entered; None where any may.
        usual: a value outside is asked about; None where none is. far: so is one that differs by so much from several of its visit.
        whole: values are whole numbers. decimals: of a value or its change within a sentence. mean_decimals: of a mean in a table.
        higher_is_better: the better direction. margin: how much worse counts as no worse.
        failure: the value of a stopped session; None for the participant's worst measured one.
        end: its part in r_end; None where it has none.
        scale: of the primary contrast. model: of the mixed model. resolution: the step between neighbouring values, 0 where continuous.
        bounded: sessions reach an end of the range.
        derived: uploaded files may give it. prediction: how evaluation predicts it; None where it does not.
    """

    key: str
    field: str
    column: str
    label: str
    short: str
    noun: str
    the_noun: str
    unit: str
    entry_unit: str
    sentence_unit: str
    difference_unit: str
    difference_words: str
    contrast_unit: str
    worse: str
    note: str = ""
    help: str
    explained: str
    description: str
    exported: str
    low: float
    high: float = math.inf
    below: float | None = None
    usual: tuple[float, float] | None = None
    far: float | None = None
    whole: bool = False
    decimals: int
    mean_decimals: int
    higher_is_better: bool
    margin: Margin
    failure: float | None
    end: EndWeight | None = None
    scale: Literal["difference", "ordinal"] = "difference"
    model: Literal["linear", "ordinal", "minutes"] = "linear"
    resolution: float = 0.0
    bounded: bool = False
    derived: bool = False
    prediction: Prediction | None = None

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"the range of {self.key} must not be empty: {self.low} to {self.high}")
        if self.scale == "ordinal" and not self.resolution > 0:
            raise ValueError(f"{self.key} is compared in steps, so its resolution must be above 0")
        if self.failure is not None:
            self.check(self.failure)

    def check(self, value: float) -> None:
        """Raise ValueError for a value outside the range, or a broken one where whole numbers are asked for."""
        whole = not self.whole or value == math.floor(value)
        if not (math.isfinite(value) and self.low <= value <= self.high and whole):
            number = "a whole number " if self.whole else ""
            within = f"from {self.low:g} to {self.high:g}" if math.isfinite(self.high) else f"of {self.low:g} or more"
            raise ValueError(f"{self.noun} must be {number}{within} ({self.unit}), not {value}")

    def loss(self, difference: Any) -> Any:
        """Return by how much a difference is worse; below 0 where it is better. A number or an array."""
        return -difference if self.higher_is_better else difference

    def worst(self, values: Iterable[float]) -> float:
        """Return the worst of at least one value."""
        return (min if self.higher_is_better else max)(values)

    def slack(self, own: Any, cdbs: Any, margin: float) -> Any:
        """Return by how much a value keeps within its margin of cDBS; below 0 it is beyond.

        Args:
            own, cdbs: the outcome under a policy and under cDBS, numbers or arrays of one shape. margin: of the margin's kind.
        """
        if self.margin.kind == "share":
            return own - (1 - margin) * cdbs if self.higher_is_better else (1 + margin) * cdbs - own
        return own - cdbs + margin if self.higher_is_better else cdbs + margin - own

    @property
    def limits(self) -> tuple[float, float]:
        """The range."""
        return self.low, self.high

    @property
    def worst_possible(self) -> float:
        """The worst end of the range; infinite where the range has no such end."""
        return self.low if self.higher_is_better else self.high

    def less_margin(self, cdbs: Any, margin: float) -> Any:
        """Return values under cDBS, a number or an array, made worse by a margin that is a share of them."""
        return (1 - margin) * cdbs if self.higher_is_better else (1 + margin) * cdbs

    def failed(self, measured: Iterable[float | None]) -> float | None:
        """Return what a session that was stopped for the participant's sake counts as.

        Args:
            measured: the outcome in all sessions of the participant that count; None or NaN where it was not measured.

        Returns:
            The stated value, else the worst measured one. None where there is neither: it is unknown then.
        """
        if self.failure is not None:
            return int(self.failure) if self.whole else self.failure
        known = [float(v) for v in measured if v is not None and math.isfinite(v)]
        return self.worst(known) if known else None
