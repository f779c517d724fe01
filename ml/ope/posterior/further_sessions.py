"""Number of further sessions near a dose that would settle an open verdict, by simulation.

Preposterior analysis (Raiffa and Schlaifer 1961, ch. 4): a truth is drawn from the posterior, and under it the mean of n sessions with
their noise. The posterior is moved by that mean as tested sessions move it (linear prediction over joint draws), and the verdict is asked
again. The number n is the least with which it is settled in four of five such futures.

The sessions do not run the policy itself but an amplitude near its dose. A plan allows amplitudes below `LOW_AMPLITUDE` for the last
`LOW_SECONDS` of a session alone. So a policy has no number where no session of a plan is near its dose. It has none where its outcomes
differ from those of constant amplitudes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.designs import NEAR_SPREAD, Bound, near_doses
from ml.ope.estimate import Estimate
from ml.ope.posterior.support import FEWEST_SESSIONS, FEWEST_VISITS, NEAR
from ml.ope.posterior.verdict import Levels, calibrate, outcome_draws, slacks
from ml.outcomes import PREDICTED
from ml.qoc import Margins, Qoc
from ml.returns import actual_return
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

NUMBERS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""Numbers of sessions that are tried; where none of them would do, no number is given."""

TOLD = 0.8
"""Share of simulated futures in which the verdict must be settled."""

FUTURES = 200
STEP = 0.01
"""Levels are tried in steps of this, fraction of cDBS."""
_SLACK = 0.02
"""By how much draws may move a session's mean from its expectation, fraction of cDBS; ten minutes of draws move it by 0.01."""
_FEWEST = 3
"""Degrees of freedom from which the noise of sessions is known."""


@dataclass(frozen=True)
class Further:
    """Sessions that would settle a verdict: how many, on how many visits at least, near which fraction of cDBS."""

    sessions: int
    visits: int
    fraction: float


def further_sessions(
    own: Estimate,
    cdbs: Estimate,
    held: Sequence[tuple[float, Estimate]],
    noise: Mapping[str, float],
    margins: Margins,
    levels: Levels,
    place: Place,
) -> Further | None:
    """Find the fewest sessions that would settle a policy's verdict; None where no plan can have them, or the dose is not known.

    Args:
        own, cdbs: posteriors of the policy and of cDBS. `held`: amplitude and posterior of constants. noise: of a session, by outcome.
        margins, levels: of the verdict. place: limits of the sessions.
    """
    support = own.details.get("support") or {}
    near = reachable(float(support["dose"]), place) if support.get("dose") is not None else None
    if near is None:
        return None
    ours, theirs = outcome_draws(own, "energy"), outcome_draws(cdbs, "energy")
    found = sessions_to_tell(
        slacks(own, cdbs, margins),
        noise,
        levels,
        shown=_shown(near.dose, cdbs, held),
        saved=theirs - ours if ours is not None and theirs is not None else None,
        near=(int(support.get("near_sessions") or 0), int(support.get("near_visits") or 0)),
        supported=own.supported,
    )
    return Further(found.sessions, found.visits, near.level) if found is not None else None


ALIKE = NEAR_SPREAD
"""Amplitudes closer than this share their sessions: their draws reach as far."""
MOST_HELD = 4
"""Sessions near one amplitude in a visit, at most."""


@dataclass(frozen=True)
class Hold:
    """Sessions of one visit near an amplitude.

    Attributes:
        fraction: of cDBS. here: how many. further: what would settle the verdict; None where they explore.
        names: of the policies whose verdicts they would settle.
    """

    fraction: float
    here: int
    further: Further | None
    names: tuple[str, ...] = ()


def worth_holding(waiting: Mapping[str, tuple[Further, float | None]], slots: int) -> tuple[Hold, ...]:
    """Choose what to keep constant in so many slots: the fewest sessions first, then the likeliest policy. Of sessions on two visits this
    one takes half.

    Args:
        waiting: by open policy the sessions that would settle it, and its probability of keeping within the margins.
    """
    made: list[Hold] = []
    for name, (further, _) in sorted(waiting.items(), key=lambda item: (item[1][0].sessions, -(item[1][1] or 0.0), item[0])):
        near = next((i for i, hold in enumerate(made) if abs(hold.fraction - further.fraction) < ALIKE), None)
        if near is not None:
            first = made[near].further
            if first is not None and first.sessions == further.sessions:
                made[near] = replace(made[near], names=(*made[near].names, name))
            continue
        room = slots - sum(hold.here for hold in made)
        if room >= 1:
            made.append(Hold(further.fraction, min(room, MOST_HELD, -(-further.sessions // further.visits)), further, (name,)))
    return tuple(made)


def worth_exploring(place: Place, slots: int) -> tuple[Hold, ...]:
    """Choose the sessions where the data cannot order policies: at the lowest amplitude that a whole session may keep, next to cDBS."""
    level = place.bound.early_lowest + NEAR_SPREAD
    return (Hold(level, min(slots, MOST_HELD), None),) if slots >= 1 and level <= 1.0 - 2 * NEAR_SPREAD else ()


def session_noise(buffer: ReplayBuffer) -> dict[str, float]:
    """Estimate the standard deviation of each outcome from session to session under one controller (and policy) at one visit.

    Random sessions of one visit may differ in dose by design, so they count only where the others have too few. An outcome is absent
    where fewer than three degrees of freedom speak about it. Units: Hz, points, percentage points.
    """
    groups: dict[tuple[object, ...], list[Qoc]] = {}
    for s in buffer.sessions:
        groups.setdefault((s.visit, s.controller, s.policy_id), []).append(s.qoc)
    steady = [rows for key, rows in groups.items() if key[1] != "random"]
    found = {}
    for name in (o.field for o, _ in PREDICTED):
        for counted in (steady, list(groups.values())):
            deviation = _within_groups([[getattr(qoc, name) for qoc in rows] for rows in counted])
            if deviation:
                found[name] = deviation
                break
    return found


def return_noise(buffer: ReplayBuffer, horizon_steps: int) -> float:
    """Estimate the standard deviation of a session's return from session to session under one controller at one visit, reward units.

    Random sessions count only where the others have too few, as in `session_noise`. The estimate is 0 with fewer than three degrees of
    freedom. A missing r_end leaves the session out where others have one; where no session has one, a return is its steps' part.
    """
    found = [(s, actual_return(s, buffer.settings, horizon_steps)) for s in buffer.sessions]
    with_end = any(value.end_reward is not None for _, value in found)
    groups: dict[tuple[object, ...], list[float | None]] = {}
    for s, value in found:
        end = value.end_reward if with_end else 0.0
        whole = None if value.step_return is None or end is None else value.step_return + end
        groups.setdefault((s.visit, s.controller, s.policy_id), []).append(whole)
    steady = [values for key, values in groups.items() if key[1] != "random"]
    return _within_groups(steady) or _within_groups(list(groups.values()))


def _within_groups(groups: Sequence[Sequence[float | None]]) -> float:
    """Compute the pooled standard deviation within groups; 0 where there are too few values, or all of a group are the same."""
    squares, freedom = 0.0, 0
    for values in groups:
        known = np.array([v for v in values if v is not None], dtype=np.float64)
        if known.size > 1:
            squares += float(((known - known.mean()) ** 2).sum())
            freedom += known.size - 1
    return float(np.sqrt(squares / freedom)) if freedom >= _FEWEST else 0.0


@dataclass(frozen=True)
class Place:
    """Within what a plan holds sessions: B (fraction of cDBS), the steps of a session, seconds of a step."""

    bound: Bound
    steps: int = 300
    period_s: float = 2.0


@dataclass(frozen=True)
class Reachable:
    """An amplitude that a plan can hold so that its sessions lie near a policy.

    Attributes:
        level: that is kept, fraction of cDBS. dose: mean of such a session.
    """

    level: float
    dose: float


def reachable(dose: float, place: Place) -> Reachable | None:
    """Find the level nearest to a policy's mean dose whose sessions are near the policy (`support.NEAR`); None where there is none.

    A session is not kept much lower than the policy itself would go to make up for minutes at which it may not be low.

    Args:
        dose: of the policy, fraction of cDBS. place: limits of the sessions.
    """
    mean_within, late_within = float(NEAR[0]) - _SLACK, float(NEAR[1]) - _SLACK
    lowest, highest = place.bound, 1.0 - NEAR_SPREAD
    wanted = min(max(dose, lowest), highest)
    tried = [wanted, *(float(v) for v in np.arange(max(lowest, dose - NEAR_SPREAD), highest, STEP))]
    for level in sorted(tried, key=lambda level: abs(level - wanted)):
        mean, late = near_doses(level, place.steps, place.period_s, lowest)
        if abs(mean - dose) <= mean_within and abs(late - dose) <= late_within:
            return Reachable(level, mean)
    return None


@dataclass(frozen=True)
class Needed:
    """Sessions that would settle a verdict: so many, on at least so many visits."""

    sessions: int
    visits: int


def sessions_to_tell(
    gaps: Mapping[str, Floats],
    noise: Mapping[str, float],
    levels: Levels,
    *,
    shown: Mapping[str, Floats] | None = None,
    saved: Floats | None = None,
    near: tuple[int, int] = (0, 0),
    supported: bool = True,
    seed: int = 0,
) -> Needed | None:
    """Find the fewest further sessions near the policy's dose that would show it as a test or as likely worse.

    Args:
        gaps: by how much each outcome keeps within its margin, draw by draw (`verdict.slacks`), [draws].
        noise: of a session, by outcome (`session_noise`). levels: of the verdict.
        shown: what such a session shows of each outcome less what cDBS shows, from the same draws, [draws]; the policy's own where None.
        saved: energy of cDBS less that of the policy, [draws]; above 0 everywhere where None.
        near: sessions, and their visits, that were near already. supported: whether the data support the policy. Else two sessions on two
            visits near it are needed too.
        seed: of the simulated futures.

    Returns:
        None where not even the largest of `NUMBERS` would do, or where the noise of no outcome is known.
    """
    names = [name for name in gaps if noise.get(name, 0.0) > 0]
    seen_of = {name: (shown or gaps)[name] for name in names if name in (shown or gaps)}
    if not seen_of:
        return None
    least = 1 if supported else max(1, FEWEST_SESSIONS - near[0])
    visits = 1 if supported else max(1, FEWEST_VISITS - near[1])
    asked = np.stack([*gaps.values(), *(() if saved is None else (saved,))])
    seen = np.stack(list(seen_of.values()))
    variance = np.array([noise[name] for name in seen_of]) ** 2
    rng = np.random.default_rng(seed)
    truths = rng.integers(0, seen.shape[1], FUTURES)
    futures, own = rng.standard_normal((FUTURES, len(seen))), rng.standard_normal(seen.shape)
    for n in NUMBERS:
        if n < max(least, visits):
            continue
        # a visit of such sessions alone has one of cDBS, from which all of them differ together
        days = max(visits, -(-n // MOST_HELD))
        told = _told(asked, len(gaps), seen, variance * (1 / n + 1 / days), truths, futures, own, levels)
        if told >= TOLD:
            return Needed(n, days)
    return None


def _shown(dose: float, cdbs: Estimate, held: Sequence[tuple[float, Estimate]]) -> dict[str, Floats] | None:
    """Predict what a session of a mean dose would show of each outcome less cDBS, by draw: between the constants next to it.

    None where there are no two constants: then the policy's own outcomes take their place.
    """
    rows = sorted(held, key=lambda pair: pair[0])
    if len(rows) < 2:
        return None
    above = min(max(1, sum(fraction < dose for fraction, _ in rows)), len(rows) - 1)
    (low, lower), (high, upper) = rows[above - 1], rows[above]
    share = min(max((dose - low) / (high - low), 0.0), 1.0)
    found = {}
    for name in (o.field for o, _ in PREDICTED):
        a, b, reference = (outcome_draws(e, name) for e in (lower, upper, cdbs))
        if a is not None and b is not None and reference is not None and a.size == b.size == reference.size:
            found[name] = (1 - share) * a + share * b - reference
    return found or None


def _told(
    asked: Floats, outcomes: int, seen: Floats, variance: Floats, truths: NDArray[np.int64], futures: Floats, own: Floats, levels: Levels
) -> float:
    """Compute the share of futures in which the verdict is settled.

    Args:
        asked: gaps, and energy saved where it is known, [outcomes or outcomes + 1, draws]. outcomes: how many gaps.
        seen: [S, draws]. variance: of the mean of the sessions, [S]. truths: draws that are true, [F]. futures: chance of the sessions,
            [F, S]. own: chance of the draws, [S, draws].
    """
    k = seen.shape[1] - 1
    away = seen - seen.mean(1, keepdims=True)
    covariance = away @ away.T / k + np.diag(variance)
    gain = (asked - asked.mean(1, keepdims=True)) @ away.T / k @ np.linalg.pinv(covariance, hermitian=True)
    sd = np.sqrt(variance)[:, None]
    told = 0
    for truth, chance in zip(truths, futures, strict=True):
        said = seen[:, truth : truth + 1] + sd * chance[:, None]
        moved = asked + gain @ (said - seen - sd * own)
        within = calibrate(float(np.mean((moved[:outcomes] >= 0).all(0))))
        saves = float(np.mean(moved[outcomes:] > 0)) if len(moved) > outcomes else 1.0
        told += (within >= levels.test_within and saves >= levels.test_saves) or 1 - within >= levels.test_within
    return told / len(truths)
