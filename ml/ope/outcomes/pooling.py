"""Dose shapes of outcomes pooled over participants, where leaving each of them out shows that it helps.

What is pooled is which of `SHAPES` an outcome has beforehand. The size of an effect, its sign and levels stay each participant's own, and
so does the evidence: a prior only adds to it. Participant i has shape s_i, and of its data only their evidence L_ik under shape k is
known:

    p ~ Dirichlet(c, ..., c),    s_i | p ~ p,    prior of a further participant = E[p | data] = (c + sum_i r_ik) / (K c + N)

with r_ik = P(s_i = k | data of all N participants). Without others it is flat, as it is where their data show no shape. One of them moves
it by no more than 1 / (K c + N). The r_ik are found by r_ik ~ L_ik (c + sum over j != i of r_jk), collapsed variational inference of order
zero (Asuncion, Welling, Smyth and Teh 2009). It is exact where evidences are certain, and for one participant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from ml.ope.outcomes.minutes import SHAPES
from ml.ope.outcomes.regressions import ORDER, Outcome

Floats = NDArray[np.float64]
Evidence = Mapping[Any, Sequence[float] | Floats]
"""Of one participant: log evidence of `SHAPES` by outcome, [K], each up to a constant."""

CONCENTRATION: Final = 1.0
"""c: all probabilities of shapes are equally likely before anybody was seen."""

FEWEST: Final = 4
"""Participants below which nothing is pooled."""

ROUNDS, TOLERANCE = 500, 1e-10


@dataclass(frozen=True)
class Proof:
    """Worth of a prior from the others, for every participant in turn.

    Attributes:
        gains: log predictive density of each participant's whole data under the prior learnt from the others, less that under the flat
            prior, [N], nats.
    """

    gains: Floats

    @property
    def participants(self) -> int:
        """N."""
        return int(self.gains.size)

    @property
    def mean(self) -> float | None:
        """Mean gain of a participant, nats; None without any."""
        return float(self.gains.mean()) if self.gains.size else None

    @property
    def standard_error(self) -> float | None:
        """Of the mean gain; None below two participants."""
        return float(self.gains.std(ddof=1) / np.sqrt(self.gains.size)) if self.gains.size > 1 else None

    @property
    def holds(self) -> bool:
        """True where at least `FEWEST` participants gain, in the mean by more than one standard error above 0."""
        if self.participants < FEWEST:
            return False
        return bool(self.gains.mean() > self.gains.std(ddof=1) / np.sqrt(self.gains.size))

    def to_json(self) -> dict[str, Any]:
        """Return `participants`, the `fewest` that are needed, `gain`, `standard_error` (nats), and whether the prior is `used`."""
        numbers = {"gain": self.mean, "standard_error": self.standard_error}
        return {"participants": self.participants, "fewest": FEWEST} | numbers | {"used": self.holds}


@dataclass(frozen=True)
class Pooled:
    """Priors of one participant's shapes from the other participants of a study.

    Attributes:
        proofs: by outcome, what priors from all others are worth to each of them, the participant among them.
        priors: log prior of `SHAPES`, [K], from the others, of every outcome whose proof holds.
    """

    proofs: dict[Outcome, Proof]
    priors: dict[Outcome, Floats]


def pool(own: Evidence, others: Sequence[Evidence]) -> Pooled:
    """Compute priors from the others' evidences, and whether to use them.

    The participant is one of those held out in turn: without it the proof would be easiest where it alone is unlike the others.

    Args:
        own, others: of the participant, and of every other one, log evidence of `SHAPES` by outcome, [K], up to a constant; an outcome may
            be absent. Outcomes that the participant lacks have no proof.

    Raises:
        ValueError: an evidence of another number of shapes, or one that is not finite.
    """
    proofs, priors = {}, {}
    for outcome in ORDER:
        if outcome not in own:
            continue
        known = [own[outcome], *(o[outcome] for o in others if outcome in o)]
        if any(len(each) != len(SHAPES) for each in known):
            raise ValueError(f"evidence of another number of dose shapes of the {outcome} than {len(SHAPES)}")
        evidence = np.array(known, dtype=np.float64)
        proofs[outcome] = prove(evidence)
        if proofs[outcome].holds:
            priors[outcome] = shape_prior(evidence[1:])
    return Pooled(proofs, priors)


def shape_prior(log_evidence: Floats) -> Floats:
    """Log prior of a further participant's shape, [K].

    Args:
        log_evidence: of every participant and shape, [N, K], each row up to a constant.

    Raises:
        ValueError: an evidence that is not finite.
    """
    n, k = _checked(log_evidence).shape
    shares = softmax(log_evidence, axis=1) if n else log_evidence
    for _ in range(ROUNDS):
        others = shares.sum(0) - shares
        found = softmax(log_evidence + np.log(CONCENTRATION + others), axis=1) if n else shares
        moved = float(np.abs(found - shares).max(initial=0.0))
        shares = found
        if moved < TOLERANCE:
            break
    return np.asarray(np.log((CONCENTRATION + shares.sum(0)) / (k * CONCENTRATION + n)), dtype=np.float64)


def prove(log_evidence: Floats) -> Proof:
    """Leave every participant out in turn.

    Args:
        log_evidence: as of `shape_prior`.

    Raises:
        ValueError: as there.
    """
    n = len(_checked(log_evidence))
    priors = [shape_prior(np.delete(log_evidence, i, axis=0)) for i in range(n)]
    gains = [gain(own, prior) for own, prior in zip(log_evidence, priors, strict=True)]
    return Proof(np.array(gains, dtype=np.float64))


def gain(log_evidence: Floats, log_prior: Floats) -> float:
    """Log predictive density of a participant's data under a prior of its shape less that under the flat one, nats; both [K]."""
    return float(logsumexp(log_evidence + log_prior) - logsumexp(log_evidence) + np.log(log_evidence.size))


def _checked(log_evidence: Floats) -> Floats:
    if not np.isfinite(log_evidence).all():
        raise ValueError("the evidence of a dose shape is not finite")
    return log_evidence
