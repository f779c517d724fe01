"""The four synthetic participants: every constant of theirs, with its source or the word `assumed`.

They follow the characters in the appendix of Gao et al. 2023 (which symptoms, which side, which medication). They are synthetic and not
fitted to any patient. K below is the position between healthy (0) and parkinsonian (1) weights of `ml.population.physiology.brain`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

from ml.mdp import MdpSettings

Hemisphere = Literal["left", "right"]


@dataclass(frozen=True, kw_only=True)
class BrainConstants:
    """Beta activity and its response.

    Attributes:
        k0: resting position between healthy and parkinsonian weights; 0.2-0.3 is noise-driven resonance around the Hopf point.
        eta: share of STN-GPe loop gain that the cDBS amplitude removes.
        a50, hill: amplitude fraction of half effect, and steepness.
        s_act: sd of log K from drifts of 90 s (activity, stress, attention).
        c_med: loss of K at full levodopa effect.
        s_k: sd of log K from fluctuations of 0.4 s.
    """

    k0: float
    eta: float
    a50: float
    hill: float
    s_act: float
    c_med: float
    s_k: float


@dataclass(frozen=True, kw_only=True)
class SymptomConstants:
    """Tremor, bradykinesia and side effects.

    Attributes:
        tremor_max: tremor severity without stimulation, on the scale none < 0.3 <= slight < 1 <= mild < 2 <= moderate < 3.2 <= strong.
        tremor_theta: how much stimulation effect it takes to end tremor with full medication.
        tremor_up_s, tremor_down_s: time constants of its return and its suppression.
        tremor_episodic: tremor in episodes of its own instead of at low stimulation.
        brady_beta_share: share of bradykinesia that follows beta (w_b); the rest follows stimulation directly.
        brady_a50, brady_hill: response of the direct share.
        grasp_min_hz, grasp_max_hz: grasp frequency at full and without bradykinesia.
        side_effect: loss of rating by over-stimulation (3 points times this at full load).
        rating_bias: habit of rating higher or lower.
    """

    tremor_max: float
    tremor_theta: float
    tremor_up_s: float
    tremor_down_s: float
    tremor_episodic: bool
    brady_beta_share: float
    brady_a50: float
    brady_hill: float
    grasp_min_hz: float
    grasp_max_hz: float
    side_effect: float
    rating_bias: float


@dataclass(frozen=True, kw_only=True)
class Regimen:
    """Medication of a visit day.

    Attributes:
        levodopa_h: hours of the 100 mg levodopa doses, counted from the first session (about 9 o'clock).
        constant: medication effect 0-1 that does not change during the day.
    """

    levodopa_h: tuple[float, ...]
    constant: float


@dataclass(frozen=True, kw_only=True)
class Programme:
    """Programme of the implanted stimulator.

    Attributes:
        rate_hz, pulse_width_us: pulse train.
        cathodes, anodes: contact numbers 0-3 of the STN lead; 16 is the case.
        sense_plus, sense_minus: contacts of the STN sensing channel.
    """

    rate_hz: float
    pulse_width_us: int
    cathodes: tuple[int, ...]
    anodes: tuple[int, ...]
    sense_plus: int
    sense_minus: int


@dataclass(frozen=True, kw_only=True)
class ReferenceBeta:
    """Mean P_beta in uV of 10 min sessions, measured on this model by `ml.population.truth.measure_reference`; shown to hold by a test."""

    cdbs: float
    at_03: float
    off: float

    @property
    def xi_beta(self) -> float:
        """Reward threshold: midway between cDBS and amplitude fraction 0.3, so that neither cDBS nor a random controller is optimal."""
        return round(0.5 * (self.cdbs + self.at_03), 3)


@dataclass(frozen=True, kw_only=True)
class ParticipantModel:
    """One synthetic participant.

    Attributes:
        code: `P1` to `P4`. salt: separates the random streams of participants with the same seed.
        hemisphere: of the controlling STN. hand: of the grasp test.
        cdbs_amplitude_ma: amplitude fraction 1.
        c2, c3, c4: suggested weights of r_end (Gao et al. 2023, section 6.2).
    """

    code: str
    salt: int
    description: str
    hemisphere: Hemisphere
    hand: Hemisphere
    cdbs_amplitude_ma: float
    programme: Programme
    c2: float
    c3: float
    c4: float
    brain: BrainConstants
    symptoms: SymptomConstants
    regimen: Regimen
    reference: ReferenceBeta

    def mdp_settings(self, **changes: Any) -> MdpSettings:
        """Suggest MDP constants, with `changes` applied on top. Beta is in uV."""
        suggested: dict[str, Any] = {"xi_beta": self.reference.xi_beta, "c2": self.c2, "c3": self.c3, "c4": self.c4}
        return MdpSettings(**(suggested | changes))


_SINEMET_TWICE = Regimen(levodopa_h=(-2.0, 3.0), constant=0.0)  # Gao et al. 2023, appendix: 7 o'clock and about noon

PARTICIPANTS: Final[dict[str, ParticipantModel]] = {
    "P1": ParticipantModel(
        code="P1",
        salt=1,
        description="Episodes of tremor only; left-hand bradykinesia follows right STN beta.",  # appendix
        hemisphere="right",
        hand="left",
        cdbs_amplitude_ma=3.0,  # assumed
        programme=Programme(rate_hz=130.0, pulse_width_us=60, cathodes=(1,), anodes=(16,), sense_plus=2, sense_minus=0),  # assumed
        c2=25.0,
        c3=25.0,
        c4=25.0,  # Gao et al. 2023, section 6.2
        brain=BrainConstants(k0=0.28, eta=0.42, a50=0.65, hill=2.0, s_act=0.20, c_med=0.15, s_k=0.35),  # assumed
        symptoms=SymptomConstants(  # assumed, shaped by the appendix
            tremor_max=2.0,
            tremor_theta=0.30,
            tremor_up_s=25.0,
            tremor_down_s=12.0,
            tremor_episodic=True,
            brady_beta_share=0.45,
            brady_a50=0.65,
            brady_hill=2.0,
            grasp_min_hz=1.9,
            grasp_max_hz=2.9,
            side_effect=0.9,
            rating_bias=0.0,
        ),
        regimen=_SINEMET_TWICE,
        reference=ReferenceBeta(cdbs=1.182, at_03=1.839, off=2.051),
    ),
    "P2": ParticipantModel(
        code="P2",
        salt=2,
        description="Very large tremor within seconds of low stimulation; right-hand bradykinesia highly correlated with left STN beta.",
        hemisphere="left",
        hand="right",
        cdbs_amplitude_ma=4.0,  # assumed
        programme=Programme(rate_hz=130.0, pulse_width_us=60, cathodes=(2,), anodes=(16,), sense_plus=3, sense_minus=1),  # assumed
        c2=10.0,
        c3=10.0,
        c4=10.0,  # Gao et al. 2023, section 6.2
        brain=BrainConstants(k0=0.28, eta=0.50, a50=0.70, hill=2.5, s_act=0.20, c_med=0.05, s_k=0.35),  # assumed
        symptoms=SymptomConstants(  # assumed, shaped by the appendix
            tremor_max=5.0,
            tremor_theta=0.54,
            tremor_up_s=8.0,
            tremor_down_s=5.0,
            tremor_episodic=False,
            brady_beta_share=0.75,
            brady_a50=0.65,
            brady_hill=2.0,
            grasp_min_hz=1.2,
            grasp_max_hz=2.5,
            side_effect=1.4,
            rating_bias=0.0,
        ),
        regimen=Regimen(levodopa_h=(), constant=0.15),  # selegiline and pramipexole (appendix); size assumed
        reference=ReferenceBeta(cdbs=1.272, at_03=2.172, off=2.319),
    ),
    "P3": ParticipantModel(
        code="P3",
        salt=3,
        description="Tremor of hands and jaw within seconds of low stimulation; beta is the most responsive of the cohort.",
        hemisphere="left",
        hand="right",
        cdbs_amplitude_ma=2.0,  # assumed
        programme=Programme(rate_hz=130.0, pulse_width_us=60, cathodes=(1,), anodes=(16,), sense_plus=2, sense_minus=0),  # assumed
        c2=10.0,
        c3=10.0,
        c4=10.0,  # Gao et al. 2023, section 6.2
        brain=BrainConstants(k0=0.29, eta=0.56, a50=0.60, hill=2.0, s_act=0.20, c_med=0.18, s_k=0.38),  # assumed
        symptoms=SymptomConstants(  # assumed, shaped by the appendix
            tremor_max=4.0,
            tremor_theta=0.52,
            tremor_up_s=10.0,
            tremor_down_s=6.0,
            tremor_episodic=False,
            brady_beta_share=0.60,
            brady_a50=0.65,
            brady_hill=2.0,
            grasp_min_hz=1.4,
            grasp_max_hz=2.6,
            side_effect=1.1,
            rating_bias=0.0,
        ),
        regimen=_SINEMET_TWICE,
        reference=ReferenceBeta(cdbs=1.166, at_03=1.912, off=2.190),
    ),
    "P4": ParticipantModel(
        code="P4",
        salt=4,
        description="Pronounced tremor; monopolar stimulation can cause neck dyskinesia, so the programme is bipolar.",
        hemisphere="left",
        hand="right",
        cdbs_amplitude_ma=3.5,  # assumed
        programme=Programme(rate_hz=130.0, pulse_width_us=60, cathodes=(1,), anodes=(2,), sense_plus=3, sense_minus=0),  # bipolar: appendix
        c2=10.0,
        c3=10.0,
        c4=10.0,  # Gao et al. 2023, section 6.2
        brain=BrainConstants(k0=0.28, eta=0.48, a50=0.65, hill=2.0, s_act=0.20, c_med=0.12, s_k=0.35),  # assumed
        symptoms=SymptomConstants(  # assumed, shaped by the appendix
            tremor_max=3.5,
            tremor_theta=0.50,
            tremor_up_s=10.0,
            tremor_down_s=8.0,
            tremor_episodic=False,
            brady_beta_share=0.60,
            brady_a50=0.65,
            brady_hill=2.0,
            grasp_min_hz=1.5,
            grasp_max_hz=2.7,
            side_effect=1.35,
            rating_bias=0.0,
        ),
        regimen=Regimen(levodopa_h=(-2.0,), constant=0.0),  # appendix: one tablet at about 7 o'clock
        reference=ReferenceBeta(cdbs=1.228, at_03=1.980, off=2.219),
    ),
}
