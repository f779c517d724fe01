"""Outcomes of a session, one record each.

Forms, tables, charts, statistics, export and the interface loop over `OUTCOMES`. An installation adds outcomes of its own by a file
(`ml.outcomes.definitions`). The priors of the outcome model stay in `ml/ope/outcomes/regressions.py`, and what is read from files with its
readers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ml.outcomes.definitions import defined_outcomes
from ml.outcomes.records import EndWeight, Margin, Outcome, Prediction

BUILT_IN: tuple[Outcome, ...] = (
    Outcome(
        key="grasp",
        field="grasp_hz",
        column="grasp_hz",
        label="Grasp frequency",
        short="Grasp",
        noun="grasp",
        the_noun="grasp",
        unit="Hz",
        entry_unit="Hz",
        sentence_unit="Hz",
        difference_unit="Hz",
        difference_words="Hz",
        contrast_unit="Hz",
        worse="slower",
        help="Full hand openings per second at the end of the session.",
        explained="Full openings of the hand per second, at the end of a session; more is better.",
        description="Grasp frequency, Hz.",
        exported="Grasp frequency, Hz, newest revision.",
        low=0.0,
        below=20.0,
        usual=(0.3, 6.0),  # hands open and close about 1 to 4 times per second in Parkinson disease, seldom above 6 in health
        decimals=1,
        mean_decimals=2,
        higher_is_better=True,
        margin=Margin(
            field="grasp_share",
            kind="share",
            default=0.10,
            least=0.01,
            most=0.5,
            unit="of the grasp frequency under cDBS",
            label="Grasp slower by",
            help="Share of the grasp frequency under cDBS, 0.1 being 10 %.",
            form_unit="of cDBS",
            description="Grasp may be slower by this share of the frequency under cDBS.",
        ),
        failure=None,
        end=EndWeight(
            setting="c2",
            sign=1.0,
            label="Weight of grasp C₂",
            help="Times the grasp frequency, Hz. 10, or 25 where symptoms are subtle; 0 drops grasp.",
            description="Weight of the grasp frequency in r_end, C2; 0 drops it.",
        ),
        derived=True,
        prediction=Prediction(kind="gaussian", model_error=(0.10, 0.03), least_error=0.02),
    ),
    Outcome(
        key="rating",
        field="rating",
        column="rating_1_10",
        label="Rating",
        short="Rating",
        noun="rating",
        the_noun="the rating",
        unit="1\u201310",
        entry_unit="of 10",
        sentence_unit="of 10",
        difference_unit="points",
        difference_words="points",
        contrast_unit="points, in pairs",
        worse="lower",
        note="by the patient (10 is best)",
        help="The participant's own, 1 worst to 10 best.",
        explained="The participant's own, 1 worst to 10 best.",
        description="The participant's rating, 1-10.",
        exported="The participant's rating, 1 worst to 10 best, newest revision.",
        low=1.0,
        high=10.0,
        far=5.0,
        whole=True,
        decimals=1,
        mean_decimals=1,
        higher_is_better=True,
        margin=Margin(
            field="rating_points",
            kind="points",
            default=1.0,
            least=0.1,
            most=5,
            unit="points",
            label="Rating lower by",
            help="On the participant's scale of 1 to 10.",
            form_unit="points",
            description="The rating may be lower by this many points.",
        ),
        failure=1.0,
        end=EndWeight(
            setting="c3",
            sign=1.0,
            label="Weight of rating C₃",
            help="Times the rating, 1 to 10. 0 drops the rating.",
            description="Weight of the rating, C3; 0 drops it.",
        ),
        scale="ordinal",
        model="ordinal",
        resolution=1.0,
        bounded=True,
        prediction=Prediction(kind="rounded", model_error=(0.13, 0.08), least_error=0.25),
    ),
    Outcome(
        key="tremor",
        field="tremor_percent",
        column="tremor_percent",
        label="Tremor",
        short="Tremor",
        noun="tremor",
        the_noun="tremor",
        unit="% of session",
        entry_unit="%",
        sentence_unit="% of the time",
        difference_unit="% points",
        difference_words="percentage points",
        contrast_unit="% points",
        worse="more",
        help="Share of the session with mild or worse tremor.",
        explained="Share of the session with mild or worse tremor. A change is told in percentage points of that time.",
        description="Share of the session with mild or worse tremor, %.",
        exported="Share of the session with mild or worse tremor, %, newest revision.",
        low=0.0,
        high=100.0,
        usual=(0.0, 95.0),
        decimals=0,
        mean_decimals=0,
        higher_is_better=False,
        margin=Margin(
            field="tremor_points",
            kind="points",
            default=10.0,
            least=0.5,
            most=50,
            unit="percentage points",
            label="Tremor more by",
            help="Of the time: 10 allows 30 % where cDBS has 20 %.",
            form_unit="% points",
            description="Tremor may take up this many more percentage points of the time.",
        ),
        failure=100.0,
        end=EndWeight(
            setting="c4",
            sign=-1.0,
            as_fraction="tremor_as_fraction",
            label="Weight of tremor C₄",
            help="Times the tremor share, taken off. 0 drops tremor.",
            description="Weight of tremor, C4; 0 drops it.",
        ),
        model="minutes",
        resolution=1.0,
        bounded=True,
        derived=True,
        prediction=Prediction(kind="binomial", model_error=(0.25, 0.27), least_error=0.5),
    ),
)
"""The outcomes of the paper."""
_DEFINED = defined_outcomes(BUILT_IN)
OUTCOMES = (*BUILT_IN, *_DEFINED.outcomes)
"""Every outcome, in the order in which forms and tables have them."""
JUDGED = tuple(o for o in OUTCOMES if _DEFINED.judged is None or o.key in _DEFINED.judged)
"""The outcomes that verdicts judge."""

FIELDS = tuple(o.field for o in OUTCOMES)
KEYS = tuple(o.key for o in OUTCOMES)
PREDICTED: tuple[tuple[Outcome, Prediction], ...] = tuple((o, o.prediction) for o in OUTCOMES if o.prediction is not None)
"""The outcomes that evaluation predicts."""

BY_KEY: Mapping[str, Outcome] = {o.key: o for o in OUTCOMES}
BY_FIELD: Mapping[str, Outcome] = {o.field: o for o in OUTCOMES}
END_WEIGHTS: Mapping[str, EndWeight] = {o.end.setting: o.end for o in OUTCOMES if o.end is not None}


def enumerated(words: Sequence[str], last: str = "and") -> str:
    """Return words as a list within a sentence: `a, b and c`."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


ALL = enumerated([o.noun for o in OUTCOMES])
ANY = enumerated([o.noun for o in OUTCOMES], "or")
"""Every outcome within a sentence: of all together, and of one of them."""
ALL_PREDICTED = enumerated([o.noun for o, _ in PREDICTED])
ANY_PREDICTED = enumerated([o.noun for o, _ in PREDICTED], "or")
"""The same of the outcomes that evaluation predicts: its chances are of these alone."""
ALL_JUDGED = enumerated([o.noun for o in JUDGED])
"""The outcomes that verdicts judge, within a sentence."""
ALL_WEIGHED = enumerated([o.noun for o in OUTCOMES if o.end is not None])
"""The outcomes that may have a part in r_end, within a sentence."""
