"""Policies that three visits find: the portfolio of the posterior against rankings by single methods and against chance.

    python -m benchmarks.evaluation.portfolio --quick                    two worlds of part A
    python -m benchmarks.evaluation.portfolio --worlds 40 --out FOLDER   40 worlds; resumable
    python -m benchmarks.evaluation.portfolio --part B ...               patients to report on; each run is counted
    python -m benchmarks.evaluation.portfolio --dlsm ...                 the order of the paper's DLSM too
    python -m benchmarks.evaluation.portfolio --named --worlds 30        whether as many sessions as a verdict names do decide

Every virtual patient has three visits of data by the stratified design. Three more visits test up to four policies each: 60 minutes, two
cDBS sessions and four others of ten minutes. `portfolio` is what the plan's page suggests: verdicts are respected, and tested sessions move
the posterior before the next visit. `and held` spends the slots that no policy takes as that page suggests: sessions near the amplitudes
that would decide soonest, or that explore where the data cannot order policies; with the visit's cDBS sessions they join the data, to which
everything is fitted again. `any verdict` is the same choice among all candidates without a hazard. `linear`, `dlsm_paper`, `random` test
the next four of their order. Reported after each visit: the true gain over cDBS of the best policy tested so far, as a share of what the
best candidate gains (`tested`), and of the policy that would be kept by what was seen (`kept`). Nothing is chosen by true returns. Patients
whose best candidate gains less than two standard errors of the truth are excluded. CPU seconds of one thread.

`--named` takes each policy of which a number of sessions would decide after the three early visits. It runs so many near the amplitude
named, at most four a visit after one of cDBS as a plan lays them out, fits everything again and asks for the verdict again: `told` is the
share that has a verdict then, which the number promises for four of five, `told_without` the same after those visits with their cDBS
sessions alone.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.support.cells import Cells
from benchmarks.support.figure import Point, draw_curves
from benchmarks.support.looks import look, said
from benchmarks.support.ope_cases import CDBS, virtual_case
from benchmarks.support.results import run_benchmark
from ml.designs import Hold, near_session
from ml.mdp import end_rewards, step_reward
from ml.ope.estimate import Estimate
from ml.ope.posterior.estimator import FittedPosterior, build
from ml.ope.posterior.further_sessions import MOST_HELD, Further, Place, further_sessions, session_noise, worth_exploring, worth_holding
from ml.ope.posterior.portfolio import portfolio
from ml.ope.posterior.tested import TestSession, differences_to_cdbs, spread_of_random
from ml.ope.posterior.verdict import SETTLED_BY_SESSIONS, Levels, verdict
from ml.ope.registry import estimators
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import WORLDS_PER_PART, World, visit_days, world
from ml.population.virtual.sessions import Days
from ml.population.virtual.world import STEPS, Part
from ml.qoc import Margins
from ml.statistics.bootstrap import percentile_interval
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

SLOTS, TEST_VISITS, EARLY_VISITS = 4, 3, 3
HOURS = (0.0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6)
"""Beginnings of the six sessions of an hour; the first and the fourth are of cDBS."""
CDBS_PLACES, TEST_PLACES = (0, 3), (1, 2, 4, 5)
TESTED = 1 << 43
"""First session number of the tests, which no other data of a world have."""
HELD = {f"held at {amplitude:g}": ConstantPolicy(amplitude) for amplitude in (0.85, 0.7, 0.55, 0.4)}
"""Constants besides the candidates, which show what sessions at them would show, as the service has them."""
SHARE = 0.9
QUICK_WORLDS, TRUTH, QUICK_TRUTH = 2, 200, 80
RESAMPLES = 1000


@dataclass(frozen=True)
class Clinic:
    """The visits after the early ones: what sessions of policies show there."""

    world: World
    policies: Mapping[str, Policy]

    def visit(self, number: int, names: tuple[str, ...]) -> list[TestSession]:
        """Run the visit's cDBS sessions and one session of each named policy. A policy meets the same noise in every arm."""
        placed = [*((CDBS, place) for place in CDBS_PLACES), *zip(names, TEST_PLACES, strict=False)]
        return [self._session(number, name, place) for name, place in placed]

    def held(
        self, number: int, levels: Sequence[float], free: Sequence[int], controls: Sequence[int] = CDBS_PLACES
    ) -> tuple[SessionTrajectory, ...]:
        """Run the visit's cDBS sessions at places `controls`, and sessions near levels in free slots, as they join the data."""
        s = self.world.settings
        rows: list[tuple[int, str, Floats, tuple[Hold, ...]]] = [(place, "cdbs", np.ones(STEPS), ()) for place in controls]
        for place, level in zip(free, levels, strict=True):
            session = near_session(level, STEPS, s.period_s, s.bound, number, place)
            rows.append((place, "random", session.amplitudes, session.holds))
        found = []
        for place, controller, amplitudes, holds in rows:
            # the first sessions of cDBS are those that the tests are compared with
            first = TESTED + 1000 * number + (10 * list(self.policies).index(CDBS) if controller == "cdbs" else 500) + place
            run = self.world.run(amplitudes[None], self._day(number, place), first)
            bound = s.bound if controller == "random" else None
            found.append(
                SessionTrajectory(
                    session_id=first,
                    visit=EARLY_VISITS + number,
                    controller=controller,
                    lead_beta=run.lead[0],
                    beta=run.beta[0],
                    amplitude=run.amplitude[0],
                    qoc=run.qoc(0),
                    random_bound=bound,
                    holds=holds,
                )
            )
        return tuple(found)

    def _day(self, number: int, place: int) -> Days:
        return visit_days(self.world.key, np.array([EARLY_VISITS + number]), np.array([HOURS[place]]))

    def early(self, buffer: ReplayBuffer) -> list[TestSession]:
        """List the cDBS sessions of earlier visits, which show how sessions of one day differ; no test is compared with them."""
        s, found = self.world.settings, []
        for one in buffer.sessions:
            if one.controller == "cdbs":
                end = one.end_reward(s)
                steps = float(one.rewards(s) @ s.gamma ** np.arange(one.steps))
                values = {"return": steps + (end or 0.0), "energy": float((one.amplitude**2).mean()), **asdict(one.qoc)}
                found.append(TestSession(None, -one.visit, {k: float(v) for k, v in values.items() if v is not None}))
        return found

    def _session(self, number: int, name: str, place: int) -> TestSession:
        w, s = self.world, self.world.settings
        which = list(self.policies).index(name)
        run = w.run(self.policies[name], self._day(number, place), TESTED + 1000 * number + 10 * which + (place if name == CDBS else 0))
        steps = step_reward(s, run.beta[0], run.amplitude[0]) @ s.gamma ** np.arange(STEPS)
        qocs = {field: float(of_sessions[0]) for field, of_sessions in run.qocs.items()}
        values = {"return": float(steps + end_rewards(s, run.qocs)[0]), "energy": float((run.amplitude**2).mean()), **qocs}
        return TestSession(None if name == CDBS else name, number, values)


@dataclass(frozen=True)
class Found:
    """Policies tested at each visit, and the one to be kept after it (cDBS where none is better).

    Attributes:
        `held`: sessions near an amplitude, by visit. ordered: whether the data could order policies, before the first visit and after
            the last one.
    """

    tested: list[tuple[str, ...]]
    kept: list[str]
    held: list[int] = field(default_factory=list)
    ordered: tuple[bool, bool] | None = None


def by_posterior(clinic: Clinic, fitted: FittedPosterior, *, respecting: bool, holding: bool = False) -> Found:
    """Run three visits of portfolios; each visit's sessions move the posterior, and those of free slots join the data."""
    sessions: list[TestSession] = clinic.early(fitted.buffer)
    tested, kept, held = [], [], []
    everyone = {**clinic.policies, **HELD} if holding else clinic.policies
    estimates = fitted.evaluate(everyone, STEPS)
    before = _ordered(estimates)
    for number in range(1, TEST_VISITS + 1):
        had = {name for names in tested for name in names}
        names = suggested(estimates, respecting, had)
        sessions += clinic.visit(number, names)
        levels = asked_for(estimates, fitted.buffer, SLOTS - len(names)) if holding else []
        if levels:
            b = fitted.buffer
            more = clinic.held(number, levels, TEST_PLACES[len(names) : len(names) + len(levels)])
            fitted = build("posterior", 0, "demo").fit(replace(b, sessions=b.sessions + more))
        shown = differences_to_cdbs(sessions, spread_of_random(fitted.buffer, STEPS)).tests
        estimates = replace(fitted, tests=shown).evaluate(everyone, STEPS)
        tested.append(names)
        held.append(len(levels))
        kept.append(max([CDBS, *sorted(had.union(names))], key=lambda name: estimates[name].value))
    return Found(tested, kept, held, (before, _ordered(estimates)))


def _ordered(estimates: Mapping[str, Estimate]) -> bool:
    return bool(estimates[CDBS].details["skill"]["told"])


def asked_for(estimates: Mapping[str, Estimate], buffer: ReplayBuffer, slots: int) -> list[float]:
    """Choose the levels of the sessions in free slots, as the plan's page says."""
    ordered = _ordered(estimates)
    holds = worth_holding(waiting_for(estimates, buffer)[0], slots) if ordered else worth_exploring(_place(buffer), slots)
    return [hold.fraction for hold in holds for _ in range(hold.here)]


def waiting_for(estimates: Mapping[str, Estimate], buffer: ReplayBuffer) -> tuple[dict[str, tuple[Further, float | None]], list[str]]:
    """Find the candidates that a number of sessions would settle, with their probability within the margins; and all that sessions may
    settle.

    Args:
        estimates: of the candidates, cDBS and `HELD`. buffer: that they rest on.
    """
    cdbs, noise = estimates[CDBS], session_noise(buffer)
    constants = [(1.0, cdbs), *((policy.amplitude, estimates[n]) for n, policy in HELD.items())]
    named: dict[str, tuple[Further, float | None]] = {}
    open_still = []
    for name, own in estimates.items():
        found = verdict(own, cdbs, Margins(), Levels())
        if name not in (CDBS, *HELD) and found.code == "cannot_tell" and found.reasons[0].code in SETTLED_BY_SESSIONS:
            open_still.append(name)
            further = further_sessions(own, cdbs, constants, noise, Margins(), Levels(), _place(buffer))
            named |= {name: (further, found.within)} if further is not None else {}
    return named, open_still


def _place(buffer: ReplayBuffer) -> Place:
    return Place(buffer.settings.bound, STEPS, buffer.settings.period_s)


def suggested(estimates: Mapping[str, Estimate], respecting: bool, had: set[str]) -> tuple[str, ...]:
    """Choose the portfolio of a visit among what may be proposed, or among all without a hazard."""
    cdbs = estimates[CDBS]
    verdicts = {n: verdict(e, cdbs, Margins(), Levels()) for n, e in estimates.items() if n not in (CDBS, *HELD)}
    able = {n for n, v in verdicts.items() if (v.proposed if respecting else not v.hazards)}
    careful = {n for n in able if verdicts[n].code == "test_with_care"} if respecting else set()
    draws = {n: np.asarray(e.details["draws"]) for n, e in estimates.items()}
    noise = float(cdbs.details["return_noise"]) * math.sqrt(1 + 1 / len(CDBS_PLACES))
    return tuple(s.name for s in portfolio({n: draws[n] - draws[CDBS] for n in able}, SLOTS, careful, had, noise))


def in_order(clinic: Clinic, order: list[str]) -> Found:
    """Test the next four of an order at each visit; keep what showed the largest mean difference to cDBS above 0."""
    seen: dict[str, float] = {CDBS: 0.0}
    tested, kept = [], []
    for number in range(1, TEST_VISITS + 1):
        names = tuple(order[SLOTS * (number - 1) : SLOTS * number])
        sessions = clinic.visit(number, names)
        reference = float(np.mean([s.values["return"] for s in sessions if s.policy is None]))
        seen |= {s.policy: s.values["return"] - reference for s in sessions if s.policy is not None}
        tested.append(names)
        kept.append(max(seen, key=seen.__getitem__))
    return Found(tested, kept)


def named(part: Part, index: int) -> dict[str, Any]:
    """Collect the numbers of further sessions after the early visits, and their results."""
    w = world(part, index)
    clinic = Clinic(w, {**w.candidates(), CDBS: ConstantPolicy(1.0)})
    buffer = w.data("stratified", visits=EARLY_VISITS)
    estimates = build("posterior", 0, "demo").fit(buffer).evaluate({**clinic.policies, **HELD}, STEPS)
    waiting, open_still = waiting_for(estimates, buffer)
    rows = [
        [name, further.sessions, *(_told(clinic, buffer, name, further, hold=hold) for hold in (True, False))]
        for name, (further, _) in waiting.items()
    ]
    return {"rows": rows, "unsettled": len(open_still) - len(waiting)}


def _told(clinic: Clinic, buffer: ReplayBuffer, name: str, further: Further, *, hold: bool) -> bool:
    """Decide whether a verdict is settled after the sessions that are named, or after the same visits without them."""
    visits = max(further.visits, -(-further.sessions // MOST_HELD))
    for number in range(1, visits + 1):
        here = further.sessions // visits + (number <= further.sessions % visits)
        levels = [further.fraction] * here if hold else []
        buffer = replace(buffer, sessions=buffer.sessions + clinic.held(number, levels, TEST_PLACES[: len(levels)], CDBS_PLACES[:1]))
    estimates = build("posterior", 0, "demo").fit(buffer).evaluate({**clinic.policies, **HELD}, STEPS)
    return verdict(estimates[name], estimates[CDBS], Margins(), Levels()).code != "cannot_tell"


def print_named(part: Part, worlds: int) -> None:
    """Print a line for each policy and, as the last line, one JSON object."""
    begun, found = time.process_time(), [named(part, index) for index in range(worlds)]
    rows = [(index, *row) for index, one in enumerate(found) for row in one["rows"]]
    sys.stdout.writelines(f"{part}{i:02d} {name}: {n} sessions; told {told}, without them {bare}\n" for i, name, n, told, bare in rows)
    figures = {
        "named": len(rows),
        "unsettled": sum(one["unsettled"] for one in found),
        "told": float(np.mean([row[3] for row in rows])) if rows else None,
        "told_without": float(np.mean([row[4] for row in rows])) if rows else None,
        "cpu_seconds": time.process_time() - begun,
    }
    sys.stdout.write(json.dumps({"name": "named", "figures": figures, "ratios": {}, "baseline": "cDBS sessions alone"}) + "\n")


def arms(part: Part, index: int, truth_sessions: int, dlsm: bool) -> dict[str, Any] | None:
    """Compute shares of the best gain by arm and visit; None where no candidate gains more than two standard errors."""
    case, w = virtual_case(part, index, truth_sessions), world(part, index)
    clinic, buffer = Clinic(w, {**case.candidates, CDBS: case.probes[CDBS]}), case.data("stratified")
    true = {n: case.truth["policies"][n]["total"] for n in clinic.policies}
    gains = {n: true[n][0] - true[CDBS][0] for n in clinic.policies}
    best = max(gains, key=gains.__getitem__)
    if gains[best] < 2 * true[best][1]:
        return None
    fitted = build("posterior", 0, "demo").fit(buffer)
    found = {
        "portfolio": by_posterior(clinic, fitted, respecting=True),
        "and held": by_posterior(clinic, fitted, respecting=True, holding=True),
        "any verdict": by_posterior(clinic, fitted, respecting=False),
    }
    orders = {"random": list(np.random.default_rng([index, 0x90F]).permutation(list(case.candidates)))}
    for method in ("linear", *(("dlsm_paper",) if dlsm else ())):
        said = estimators(0, demo=True)[method].fit(buffer).evaluate(case.candidates, STEPS)
        orders[method] = sorted(said, key=lambda n: -said[n].value)
    found |= {name: in_order(clinic, order) for name, order in orders.items()}
    return {name: _shares(one, gains, gains[best]) for name, one in found.items()}


def _shares(found: Found, gains: Mapping[str, float], best: float) -> dict[str, list[float]]:
    tested = [max([0.0, *(gains[n] for names in found.tested[: k + 1] for n in names)]) / best for k in range(TEST_VISITS)]
    return {
        "tested": tested,
        "kept": [gains[n] / best for n in found.kept],
        "sessions": [float(len(n)) for n in found.tested],
        "held": [float(n) for n in found.held],
        "ordered": [float(told) for told in found.ordered or ()],
    }


def curves(shares: Mapping[str, list[dict[str, list[float]]]], figure: str) -> dict[str, list[Point]]:
    """Compute means over patients with 90 % intervals after each visit, by arm."""
    rng, found = np.random.default_rng(0), {}
    for arm, rows in shares.items():
        points = []
        for column in np.array([row[figure] for row in rows]).T:
            interval = percentile_interval(rng.choice(column, (RESAMPLES, column.size)).mean(1), 0.9)
            points.append((float(column.mean()), interval.low, interval.high))
        found[arm] = points
    return found


def lines(shares: Mapping[str, list[dict[str, list[float]]]]) -> Iterator[str]:
    """Yield a table of the curves, one row for each arm and figure."""
    yield f"{'':12} {'':8} {'after visit 1':>24} {'2':>24} {'3':>24} {f'>= {SHARE:g} after 3':>16}\n"
    for figure in ("tested", "kept"):
        for arm, points in curves(shares, figure).items():
            told = "".join(f" {f'{mean:.2f} ({low:.2f} to {high:.2f})':>24}" for mean, low, high in points)
            most = float(np.mean([row[figure][-1] >= SHARE for row in shares[arm]]))
            yield f"{arm:12} {figure:8}{told} {most:16.2f}\n"
    for arm, rows in shares.items():
        first = [row["ordered"] for row in rows if row["ordered"]]
        if first:
            mute = [after for before, after in first if not before]
            yield f"{arm:12} no order told at first in {len(mute)} of {len(first)}; in {sum(mute):.0f} of these one is told after visit 3\n"


def main() -> None:
    """Print the curve as a table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--dlsm", action="store_true", help="the order of the paper's DLSM as well")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further world after so many minutes")
    parser.add_argument("--out", type=Path, help="folder of the finished worlds and of portfolio.svg; a temporary one by default")
    parser.add_argument("--named", action="store_true", help="whether as many sessions as a verdict names do decide")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["portfolio", *sys.argv[1:]]), None)
    sys.stdout.write(f"{said()}\n")
    if chosen.named:
        print_named(chosen.part, min(chosen.worlds, QUICK_WORLDS) if chosen.quick else chosen.worlds)
        return
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-portfolio-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"portfolio{'-quick' if chosen.quick else ''}{'-dlsm' if chosen.dlsm else ''}.jsonl")
    begun = time.monotonic()
    for index in range(min(chosen.worlds, QUICK_WORLDS) if chosen.quick else chosen.worlds):
        if time.monotonic() - begun > 60 * chosen.minutes:
            break
        if cells.get(f"{chosen.part}{index:02d}") is None:
            start = time.process_time()
            found = arms(chosen.part, index, QUICK_TRUTH if chosen.quick else TRUTH, chosen.dlsm)
            cells.add(f"{chosen.part}{index:02d}", arms=found, seconds=time.process_time() - start)
    rows = [cell["arms"] for cell in cells.all(chosen.part) if cell["arms"] is not None]
    shares = {arm: [row[arm] for row in rows] for arm in (rows[0] if rows else ())}
    sys.stdout.writelines(
        [f"{len(rows)} virtual patients, share of the best candidate's true gain over cDBS, 90 % intervals\n", *lines(shares)]
    )
    titles = {"tested": "Best policy tested so far", "kept": "Policy kept by what was seen"}
    if rows:
        panels = {f"{title}, share of the best gain": curves(shares, figure) for figure, title in titles.items()}
        (out / "portfolio.svg").write_text(draw_curves(panels, "visits with tests"))
    figures = {
        f"{arm}_{figure}".replace(" ", "_"): float(np.mean([r[figure][-1] for r in of]))
        for arm, of in shares.items()
        for figure in ("tested", "kept")
    }
    figures |= {"n_worlds": len(rows), "cpu_seconds_per_world": float(np.mean([c["seconds"] for c in cells.all(chosen.part)]))}
    sys.stdout.write(json.dumps({"name": "portfolio", "figures": figures, "ratios": {}, "baseline": "linear model alone"}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
