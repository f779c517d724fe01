"""The C text that is the same for every policy: types, the safety envelope, tanh. Rules as in `runtime/envelope.py`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TYPES = """\
/* Why a decision differs from the network's wish: bits of `reasons`. */
enum {
    BETALOOP_NO_BETA = 1,
    BETALOOP_STALE_BETA = 2,
    BETALOOP_INVALID_BETA = 4,
    BETALOOP_WRONG_SIGNAL = 8,
    BETALOOP_WINDOW_INCOMPLETE = 16,
    BETALOOP_WINDOW_GAP = 32,
    BETALOOP_LATE_SAMPLE = 64,
    BETALOOP_POLICY_OUTPUT = 256,
    BETALOOP_MINIMUM = 512,
    BETALOOP_MAXIMUM = 1024,
    BETALOOP_RAMP = 2048,
    BETALOOP_SATURATED_BETA = 4096,
    BETALOOP_FROZEN_BETA = 8192,
    BETALOOP_BETA_LEVEL = 16384,
    BETALOOP_IMPUTED_BETA = 65536
};

/* One beta amplitude: the end of its window, its value (NaN where the device gave none), and what it says it is. */
typedef struct {
    int64_t t_ms;
    float beta;
    const char *unit;
    const char *source;
} betaloop_sample;

/* What the next decision depends on. Set up by betaloop_start. */
typedef struct {
    int64_t last_sample_ms;
    int64_t last_valid_ms;
    int64_t last_decision_ms;
    int32_t has_sample;
    int32_t has_decision;
    int32_t streak;
    int32_t imputed; /* of the window */
    int32_t equal;
    float last_beta;
    float level;
    float amplitude_ma;
    betaloop_score scores[BETALOOP_WINDOW];
    uint8_t made[BETALOOP_WINDOW]; /* 1 where the score is of an imputed beta amplitude */
} betaloop_state;

typedef struct {
    float amplitude_ma; /* to deliver */
    float fraction;     /* the network's answer; -1 where it was not asked */
    int32_t fallback;   /* 1: the cDBS amplitude stands in for the network */
    int32_t valid;      /* beta amplitudes in the window, imputed ones too */
    uint32_t reasons;
} betaloop_decision;
"""

_LARGEST = 7.90531110763549805  # tanh of it is 1 in float32
_OVER = (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08, 1.48572235717979e-05,
         6.37261928875436e-04, 4.89352455891786e-03)  # fmt: skip
_UNDER = (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)


def _horner(name: str, coefficients: tuple[float, ...]) -> str:
    first, *others = coefficients
    return "".join([f"    {name} = {first:.14e}f;\n", *(f"    {name} = {name} * s + {c:.14e}f;\n" for c in others)])


TANH = f"""\
/* tanh as a ratio of polynomials, within 1e-6 of the true value; NaN stays NaN. */
betaloop_linkage float betaloop_tanh(float x) {{
    float s, p, q;
    if (x > {_LARGEST!r}f) x = {_LARGEST!r}f;
    if (x < -{_LARGEST!r}f) x = -{_LARGEST!r}f;
    s = x * x;
{_horner("p", _OVER)}{_horner("q", _UNDER)}    return x * p / q;
}}
"""


def header_tanh(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the tanh of the C header, in float32: for networks with tanh between their layers, where its error may grow."""
    x = np.clip(x, np.float32(-_LARGEST), np.float32(_LARGEST))
    s = x * x
    over, under = (np.float32(0.0) * s, np.float32(0.0) * s)
    for c in _OVER:
        over = over * s + np.float32(c)
    for c in _UNDER:
        under = under * s + np.float32(c)
    return np.asarray(x * over / under, dtype=np.float32)


ENVELOPE = """\
betaloop_linkage int betaloop_same(const char *a, const char *b) {
    if (!a || !b) return 0;
    while (*a && *a == *b) {
        ++a;
        ++b;
    }
    return *a == *b;
}

/* Start a new window. */
betaloop_linkage void betaloop_forget(betaloop_state *s) {
    int i;
    s->streak = 0;
    s->imputed = 0;
    for (i = 0; i < BETALOOP_WINDOW; ++i) s->made[i] = 0;
}

/* The start of a session: cDBS in force, no beta yet. */
betaloop_linkage void betaloop_start(betaloop_state *s) {
    int i;
    s->last_sample_ms = 0;
    s->last_valid_ms = 0;
    s->last_decision_ms = 0;
    s->has_sample = 0;
    s->has_decision = 0;
    s->equal = 0;
    s->last_beta = -1.0f;
    s->level = 0.0f;
    s->amplitude_ma = BETALOOP_CDBS_MA;
    for (i = 0; i < BETALOOP_WINDOW; ++i) s->scores[i] = 0;
    betaloop_forget(s);
}

/* Move the window on by one beta amplitude. */
betaloop_linkage void betaloop_push(betaloop_state *s, float beta, uint8_t made) {
    int i;
    if (s->streak < BETALOOP_WINDOW) ++s->streak;
    s->level = s->streak == 1 ? beta : s->level + (beta - s->level) / (float)s->streak;
    s->imputed += made - s->made[0];
    for (i = 0; i + 1 < BETALOOP_WINDOW; ++i) {
        s->scores[i] = s->scores[i + 1];
        s->made[i] = s->made[i + 1];
    }
    s->scores[BETALOOP_WINDOW - 1] = betaloop_score_of(beta);
    s->made[BETALOOP_WINDOW - 1] = made;
}

/* Judge a new beta amplitude; a valid one enters the window, after what was lost before it. Returns the reasons against it. */
betaloop_linkage uint32_t betaloop_admit(betaloop_state *s, int64_t now_ms, const betaloop_sample *sample) {
    uint32_t reasons = 0;
    uint64_t spacing;
    float before = s->last_beta, level = s->level, line;
    int had = s->has_sample, lost = 0, i;
    if (sample->t_ms > now_ms || (had && sample->t_ms <= s->last_sample_ms)) return BETALOOP_LATE_SAMPLE;
    s->last_sample_ms = sample->t_ms;
    s->has_sample = 1;
    if (!betaloop_same(sample->unit, BETALOOP_UNIT) || !betaloop_same(sample->source, BETALOOP_SOURCE)) reasons = BETALOOP_WRONG_SIGNAL;
    if (BETALOOP_MOST_IMPUTED > 0 && !reasons && sample->beta != sample->beta) return BETALOOP_INVALID_BETA; /* lost: may be imputed */
    if (!(sample->beta >= 0.0f && sample->beta <= 3.4028234663852886e38f)) {
        reasons |= BETALOOP_INVALID_BETA;
        s->equal = 0;
    } else {
        s->equal = s->equal && sample->beta == s->last_beta ? s->equal + (s->equal < BETALOOP_FROZEN_AFTER) : 1;
        s->last_beta = sample->beta;
        if (sample->beta > BETALOOP_BETA_MAX) reasons |= BETALOOP_SATURATED_BETA;
        if (s->equal >= BETALOOP_FROZEN_AFTER) reasons |= BETALOOP_FROZEN_BETA;
    }
    if (reasons) {
        betaloop_forget(s);
        return reasons;
    }
    if (s->streak) {
        spacing = (uint64_t)sample->t_ms - (uint64_t)s->last_valid_ms;
        if (spacing < BETALOOP_CLOSEST_MS || spacing > BETALOOP_FARTHEST_MS + (uint64_t)BETALOOP_MOST_IMPUTED * BETALOOP_PERIOD_MS) {
            betaloop_forget(s);
            reasons = BETALOOP_WINDOW_GAP;
        } else if (spacing > BETALOOP_FARTHEST_MS)
            lost = (int)((spacing - BETALOOP_FARTHEST_MS + BETALOOP_PERIOD_MS - 1) / BETALOOP_PERIOD_MS);
    }
    for (i = 1; i <= lost; ++i) {
        line = before + (sample->beta - before) * (float)i / (float)(lost + 1);
        betaloop_push(s, level + BETALOOP_CARRIED_OVER * (line - level), 1);
    }
    betaloop_push(s, sample->beta, 0);
    s->last_valid_ms = sample->t_ms;
    return reasons;
}

/* Decide on the amplitude of the period that starts now. `sample`: the beta amplitude that came since the last decision; 0: none came. */
betaloop_linkage betaloop_decision betaloop_decide(betaloop_state *s, int64_t now_ms, const betaloop_sample *sample) {
    betaloop_decision d;
    uint32_t reasons = 0, trouble;
    uint64_t elapsed = BETALOOP_PERIOD_MS;
    float most, wanted, requested, amplitude, before = s->amplitude_ma;
    if (s->has_sample && now_ms < s->last_sample_ms) { /* the clock has run back: what came before is forgotten */
        s->has_sample = 0;
        betaloop_forget(s);
    }
    if (s->has_decision && now_ms < s->last_decision_ms) s->last_decision_ms = now_ms;
    if (sample) reasons = betaloop_admit(s, now_ms, sample);
    trouble = reasons & ~(uint32_t)(BETALOOP_LATE_SAMPLE | BETALOOP_WINDOW_GAP);
    d.fraction = -1.0f;
    d.valid = s->streak;
    if (!s->has_sample) trouble |= BETALOOP_NO_BETA;
    else if ((uint64_t)now_ms - (uint64_t)s->last_sample_ms > BETALOOP_STALE_AFTER_MS)
        trouble |= BETALOOP_STALE_BETA;
    if (s->streak < BETALOOP_WINDOW || s->imputed > BETALOOP_MOST_IMPUTED) trouble |= BETALOOP_WINDOW_INCOMPLETE;
    else if (!(s->level >= BETALOOP_LEVEL_LOW && s->level <= BETALOOP_LEVEL_HIGH))
        trouble |= BETALOOP_BETA_LEVEL;
    if (!trouble) {
        d.fraction = betaloop_fraction(s->scores);
        if (!(d.fraction >= -1e-4f && d.fraction <= 1.0f + 1e-4f)) trouble |= BETALOOP_POLICY_OUTPUT;
    }
    if (s->has_decision) elapsed = now_ms > s->last_decision_ms ? (uint64_t)now_ms - (uint64_t)s->last_decision_ms : 0;
    if (elapsed > 0) {
        s->last_decision_ms = now_ms;
        s->has_decision = 1;
    }
    if (elapsed > BETALOOP_PERIOD_MS) elapsed = BETALOOP_PERIOD_MS;
    d.reasons = reasons | trouble;
    d.fallback = trouble != 0;
    if (trouble) {
        s->amplitude_ma = d.amplitude_ma = BETALOOP_CDBS_MA; /* at once, in this decision: not ramped */
        return d;
    }
    if (s->imputed) d.reasons |= BETALOOP_IMPUTED_BETA;
    most = BETALOOP_RAMP_MA_PER_S * 0.001f * (float)elapsed;
    requested = (d.fraction < 0.0f ? 0.0f : d.fraction > 1.0f ? 1.0f : d.fraction) * BETALOOP_CDBS_MA;
    wanted = requested < BETALOOP_MIN_MA ? BETALOOP_MIN_MA : requested > BETALOOP_MAX_MA ? BETALOOP_MAX_MA : requested;
    if (wanted > requested + BETALOOP_FLAG_MA) d.reasons |= BETALOOP_MINIMUM;
    if (wanted < requested - BETALOOP_FLAG_MA) d.reasons |= BETALOOP_MAXIMUM;
    amplitude = wanted > before + most ? before + most : wanted < before - most ? before - most : wanted;
    amplitude = amplitude < BETALOOP_MIN_MA ? BETALOOP_MIN_MA : amplitude > BETALOOP_MAX_MA ? BETALOOP_MAX_MA : amplitude;
    if (amplitude > wanted + BETALOOP_FLAG_MA || amplitude < wanted - BETALOOP_FLAG_MA) d.reasons |= BETALOOP_RAMP;
    s->amplitude_ma = d.amplitude_ma = amplitude;
    return d;
}
"""

SELF_TEST = """\
int main(void) {
    betaloop_score scores[BETALOOP_WINDOW];
    betaloop_state state;
    double worst = 0.0, worst_ma = 0.0;
    long wrong = 0, i, j;
    for (i = 0; i < WINDOWS; ++i) {
        double difference;
        for (j = 0; j < BETALOOP_WINDOW; ++j) scores[j] = betaloop_score_of(windows[i][j]);
        difference = (double)betaloop_fraction(scores) - (double)expected[i];
        if (difference < 0) difference = -difference;
        if (difference > worst) worst = difference;
        if (!(difference <= TOLERANCE)) ++wrong;
    }
    betaloop_start(&state);
    for (i = 0; i < STEPS; ++i) {
        betaloop_sample sample;
        betaloop_decision d;
        double difference;
        sample.t_ms = steps[i].t_ms;
        sample.beta = steps[i].valid ? steps[i].beta : zero / zero;
        sample.unit = steps[i].unit;
        sample.source = steps[i].source;
        d = betaloop_decide(&state, steps[i].now_ms, steps[i].came ? &sample : (const betaloop_sample *)0);
        difference = (double)d.amplitude_ma - (double)steps[i].amplitude_ma;
        if (difference < 0) difference = -difference;
        if (difference > worst_ma) worst_ma = difference;
        if (!(difference <= TOLERANCE_MA) || (d.reasons & FALLBACK_REASONS) != (steps[i].reasons & FALLBACK_REASONS)) {
            ++wrong;
            printf("step %ld: %.7g mA, reasons %lu; expected %.7g mA, %lu\\n", i, (double)d.amplitude_ma, (unsigned long)d.reasons,
                   (double)steps[i].amplitude_ma, (unsigned long)steps[i].reasons);
        }
    }
    printf("windows %ld, worst difference %.3g; steps %ld, worst difference %.3g mA; %ld wrong\\n", (long)WINDOWS, worst, (long)STEPS,
           worst_ma, wrong);
    return wrong ? 1 : 0;
}
"""
