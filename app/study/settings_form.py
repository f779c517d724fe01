"""Changes of a person to what a form showed, so that an old form takes back nothing that it did not touch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Generic, TypeVar

from app.platform.errors import Conflict
from app.platform.numbers import typed
from app.platform.web.forms import same_value
from ml.formats import SOURCE_NAMES
from ml.outcomes import END_WEIGHTS


@dataclass(frozen=True)
class Shown:
    """Content of a form at one revision.

    Attributes:
        number: of the revision.
        fields: field name to text.
        author: who made the revision.
    """

    number: int
    fields: Mapping[str, str]
    author: str


@dataclass(frozen=True)
class OwnChanges:
    """Changes of a person to what the form showed.

    Attributes:
        fields: field name to typed text, where it differs from what the form showed and from what is stored now.
        conflicts: of those, the ones that another person changed after the form was opened: `where` and `what`.
    """

    fields: dict[str, str]
    conflicts: list[dict[str, str]]

    def refuse_conflicts(self) -> None:
        """Raise Conflict where two people changed the same field."""
        if self.conflicts:
            raise Conflict(
                "Another person changed the same values after this form was opened; nothing was saved.",
                "What you typed is still in the form: save again to replace what is stored, or load the page again to keep it.",
                errors=self.conflicts,
            )


def own_changes(values: Mapping[str, Any], seen: str | None, revisions: Sequence[Shown], labels: Mapping[str, str]) -> OwnChanges:
    """Compare a posted form with the revision that it showed, so that an old form takes back nothing that it did not touch.

    Args:
        values: the posted form; a field that it does not have is not changed.
        seen: number of the revision that the form showed; None for a post that names none: it is compared with the newest one.
            A number that does not exist makes every change a conflict.
        revisions: all of them, oldest first.
        labels: names of the fields as the page shows them.
    """
    present = revisions[-1]
    known = present if seen is None else next((r for r in revisions if str(r.number) == seen.strip()), None)
    fields, conflicts = {}, []
    for name, stored in present.fields.items():
        typed = str(values.get(name, stored)).strip()
        shown = known.fields[name].strip() if known else None
        if same_value(typed, stored) or (shown is not None and same_value(typed, shown)):
            continue
        fields[name] = typed
        if shown is None or not same_value(shown, stored):
            author = next((b.author for a, b in reversed(list(pairwise(revisions))) if a.fields[name] != b.fields[name]), present.author)
            what = f"stored now: {stored or 'no value'}, by {author}; you typed: {typed or 'no value'}"
            conflicts.append({"where": labels.get(name, name), "what": what})
    return OwnChanges(fields, conflicts)


def reason_of(values: Mapping[str, Any]) -> str | None:
    """Return the reason that a posted form gives, if any."""
    return str(values.get("reason", "")).strip()[:1000] or None


# The settings form: every setting with its unit, what it does and what happens when it changes.

Row = TypeVar("Row")


@dataclass(frozen=True)
class SettingField:
    """One setting on the page.

    Attributes:
        name: member of `SettingsIn`.
        options: value and label of each choice; empty for a field to type into.
    """

    name: str
    label: str
    help: str
    unit: str = ""
    options: tuple[tuple[str, str], ...] = ()
    attrs: Mapping[str, Any] = field(default_factory=lambda: {"inputmode": "decimal"})


@dataclass(frozen=True)
class SettingGroup:
    """Settings that belong together."""

    title: str
    fields: tuple[SettingField, ...]


_WHOLE: dict[str, Any] = {"inputmode": "numeric"}
_WORDS: dict[str, Any] = {"maxlength": 40, "autocomplete": "off"}
SOURCES = (
    ("", "not stated"),
    ("time_domain", "time-domain LFP, band-passed and averaged here"),
    *SOURCE_NAMES.items(),
    ("table", "uploaded table"),
)

GROUPS = (
    SettingGroup(
        "Beta and stimulation",
        (
            SettingField(
                "xi_beta", "Beta threshold",
                "Below it a step counts as good. In the unit of the beta trace. No default: jobs do not start without it.",
            ),
            SettingField(
                "beta_unit", "Unit of beta", "As the trace states it, e.g. uV. Traces of another unit are not learned from.", attrs=_WORDS
            ),
            SettingField("beta_source", "Source of beta", "Where the trace that drives the controller comes from.", options=SOURCES),
            SettingField(
                "cdbs_amplitude_ma", "cDBS amplitude",
                "Used where a visit states none. The amplitude fraction is milliamperes divided by it.", "mA",
            ),
            SettingField("beta_low_hz", "Beta band from", "Lower edge of the band, for beta computed from time-domain LFP.", "Hz"),
            SettingField("beta_high_hz", "Beta band to", "Upper edge of the band.", "Hz"),
            SettingField(
                "min_valid_fraction", "Valid share of a window",
                "Coverage: a window whose measured samples cover less than this share counts as missing, 0 to 1.",
            ),
            SettingField(
                "most_imputed", "Missing beta filled in",
                "Of the beta values before a decision, how many may be taken from their neighbours, never the newest; 0 for none.",
                "steps", attrs=_WHOLE,
            ),
            SettingField(
                "beta_measure", "Measure of beta", "What is computed from time-domain LFP. Recordings read before keep theirs.",
                options=(("rms", "RMS amplitude, in the LFP's unit"), ("power", "power, in the LFP's unit squared")),
            ),
            SettingField(
                "pool_programmings", "Sessions of another programming",
                "Contacts, pulse width and rate of the newest session count as the participant's. A fraction is another dose under others.",
                options=(("no", "are not learned from"), ("yes", "are learned from too")),
            ),
        ),
    ),
    SettingGroup(
        "Decisions and time",
        (
            SettingField(
                "window", "Beta values seen (W)", "The newest beta values, by which a policy decides. The paper uses 10.", "steps",
                attrs=_WHOLE,
            ),
            SettingField("period_s", "Step length (m)", "Time between two decisions. The paper uses 2 s.", "s"),
            SettingField("gamma", "Discount γ", "Weight of the next step against this one, 0 to below 1. The paper gives none."),
        ),
    ),
    SettingGroup(
        "Rewards per step",
        (
            SettingField("r_a", "Beta below the threshold", "Reward of such a step. The paper uses 0."),
            SettingField("r_b", "Beta at or above it", "Reward of such a step, not more than below it. The paper uses −1."),
            SettingField("c1", "Price of amplitude C₁", "Taken off per step, times the amplitude fraction. The paper uses 0.3."),
        ),
    ),
    SettingGroup(
        "End-of-session reward",
        (
            *(SettingField(name, weight.label, weight.help) for name, weight in END_WEIGHTS.items()),
            SettingField(
                "tremor_as_fraction", "Tremor enters as", "As per cent, it would outweigh the others a hundredfold.",
                options=(("yes", "a fraction, 0 to 1"), ("no", "per cent, 0 to 100")),
            ),
            SettingField(
                "pool_shapes", "Shape of the answer to the dose",
                "At which amplitudes an outcome begins to answer, never how much. Others count where that is shown to help.",
                options=(("no", "from this participant alone"), ("yes", "from the site's others too")),
            ),
        ),
    ),
    SettingGroup(
        "Random sessions of early visits",
        (
            SettingField("lower_bound", "Lower bound B", "No random session goes below this fraction of cDBS. It never bounds a policy."),
            SettingField(
                "design", "Design", "Stratified: a level for each session, draws held 10 to 60 s. The paper's: a new draw every step.",
                options=(("stratified", "stratified, held draws"), ("paper", "the paper's")),
            ),
            SettingField(
                "design_ladder", "Titration ladder", "1, 0.8, 0.6, … of cDBS, 2 minutes each; in the stratified design alone.",
                options=(("no", "none"), ("yes", "first of each visit")),
            ),
            SettingField(
                "early_visits", "Early visits", "Over so many visits the stratified levels are spread.", "visits", attrs=_WHOLE
            ),
        ),
    ),
)  # fmt: skip

_AT_ENROLMENT = ("cdbs_amplitude_ma",)
AT_ENROLMENT = tuple(f for group in GROUPS for f in group.fields if f.name in _AT_ENROLMENT)
"""Settings that are known at enrolment."""
LATER = tuple(SettingGroup(group.title, tuple(f for f in group.fields if f.name not in _AT_ENROLMENT)) for group in GROUPS)
"""What has a default, or comes from the data."""
LABELS = {f.name: f.label for group in GROUPS for f in group.fields}


def texts(source: object, names: Iterable[str] = LABELS) -> dict[str, str]:
    """Write the settings (or other named values of a row or API type) as the form's text."""
    return {name: _text(getattr(source, name)) for name in names}


@dataclass(frozen=True)
class VersionChange(Generic[Row]):
    """A version of settings or margins and what it changed: label, value before, value after."""

    row: Row
    changes: list[tuple[str, str, str]]


def history(versions: Sequence[Row], labels: Mapping[str, str] = LABELS) -> list[VersionChange[Row]]:
    """List all versions, newest first, with their changes; the first one is the enrolment's."""
    return history_of([(row, {labels[n]: text for n, text in texts(row, labels).items()}) for row in versions])


def history_of(versions: Sequence[tuple[Row, Mapping[str, str]]], first_tells: bool = False) -> list[VersionChange[Row]]:
    """List versions with changes by label, newest first; with `first_tells` the first one is a change of nothing."""
    found = [VersionChange(row, [(n, "—", text) for n, text in said.items() if text and first_tells]) for row, said in versions[:1]]
    for (_, old), (after, new) in pairwise(versions):
        found.append(VersionChange(after, [(n, old[n] or "—", new[n] or "—") for n in new if old[n] != new[n]]))
    return found[::-1]


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return typed(value, 10) if isinstance(value, float) else str(value)
